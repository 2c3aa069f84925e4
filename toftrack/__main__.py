"""`python -m toftrack`, the same as the command `toftrack`."""

import sys

from toftrack.programs.main import main

if __name__ == "__main__":
    sys.exit(main())
