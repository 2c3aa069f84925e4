"""Pictures of a finished run: `python -m toftrack.figures`."""

import sys

import toftrack.early_interrupt  # noqa: F401  # before all others
from toftrack.programs.main import main

if __name__ == "__main__":
    sys.exit(main(["figures", *sys.argv[1:]]))
