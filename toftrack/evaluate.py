"""Evaluate the tracker on a public data set: `python -m toftrack.evaluate`."""

import sys

import toftrack.early_interrupt  # noqa: F401  # before all others
from toftrack.programs.main import main

if __name__ == "__main__":
    sys.exit(main(["evaluate", *sys.argv[1:]]))
