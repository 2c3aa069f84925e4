"""Learn the space of hand poses that the tracker searches: `python train_pose_space.py --help`."""

import sys

import hydra
from omegaconf import DictConfig

from toftrack.programs import command_line


@hydra.main(version_base="1.3", config_path="conf", config_name="train_pose_space")
@command_line.sweep_job
def main(config: DictConfig) -> float:
    """Train, write the model and its figures, and return what a sweep minimises."""
    from toftrack.programs.train import train  # takes seconds: an override's error comes before

    return train(config)


if __name__ == "__main__":
    sys.exit(command_line.run(main))
