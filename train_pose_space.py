"""Learn the space of hand poses that the tracker searches: `python train_pose_space.py --help`."""

import sys

import toftrack.programs.early_interrupt  # noqa: F401  # before all others
from toftrack.programs.main import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
