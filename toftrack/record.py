"""Record what an SR3000 sends: `python -m toftrack.record`."""

import sys

import toftrack.early_interrupt  # noqa: F401  # before all others
from toftrack.programs.main import main

if __name__ == "__main__":
    sys.exit(main(["record", *sys.argv[1:]]))
