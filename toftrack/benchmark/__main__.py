"""`python -m toftrack.benchmark`."""

import sys

import toftrack.early_ending  # noqa: F401  # before all others
from toftrack.benchmark.scoring import main

if __name__ == "__main__":
    sys.exit(main())
