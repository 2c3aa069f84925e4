"""`python -m toftrack`, the same as the command `toftrack`."""

import sys

import toftrack.programs.early_interrupt  # noqa: F401  # before all others
from toftrack.programs.main import main

if __name__ == "__main__":
    sys.exit(main())
