"""Follow a hand through the frames of a depth camera or a recording: `python track.py --help`."""

import sys

import hydra
from omegaconf import DictConfig

from toftrack.programs import command_line


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
@command_line.sweep_job
def main(config: DictConfig) -> float:
    """Track, write the results, and return what a sweep minimises."""
    # The device comes before the seconds that torch takes: a missing camera is told at once.
    device = hydra.utils.instantiate(config.device)
    from toftrack.programs import track as app

    return app.track(config, device)


if __name__ == "__main__":
    sys.exit(command_line.run(main))
