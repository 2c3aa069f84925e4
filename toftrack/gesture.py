"""Your own gestures: `python -m toftrack.gesture add NAME RECORDING --from 2.0 --to 3.0`."""

import sys

import toftrack.early_interrupt  # noqa: F401  # before all others
from toftrack.programs.main import main

if __name__ == "__main__":
    sys.exit(main(["gesture", *sys.argv[1:]]))
