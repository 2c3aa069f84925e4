"""What a sweep found: `python -m toftrack.report`."""

import sys

from toftrack.programs.report import main

if __name__ == "__main__":
    sys.exit(main())
