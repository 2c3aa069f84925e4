"""`python -m toftrack.benchmark`."""

import sys

from toftrack.benchmark.scoring import main

if __name__ == "__main__":
    sys.exit(main())
