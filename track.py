"""Follow a hand through the frames of a depth camera or a recording: `python track.py --help`."""

import sys

import toftrack.programs.early_interrupt  # noqa: F401  # before all others
from toftrack.programs.main import main

if __name__ == "__main__":
    sys.exit(main(["track", *sys.argv[1:]]))
