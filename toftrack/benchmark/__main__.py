"""`python -m toftrack.benchmark`."""

import sys

import toftrack.early_interrupt  # noqa: F401  # before all others
from toftrack.benchmark.command import main
from toftrack.errors import ToftrackError

if __name__ == "__main__":
    try:
        sys.exit(main())
    except ToftrackError as error:
        sys.exit(f"error: {error}")
