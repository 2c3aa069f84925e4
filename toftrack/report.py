"""What a sweep found: `python -m toftrack.report`."""

import sys

import toftrack.early_interrupt  # noqa: F401  # before all others
from toftrack.programs.main import main

if __name__ == "__main__":
    sys.exit(main(["report", *sys.argv[1:]]))
