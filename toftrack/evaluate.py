"""Evaluate the tracker on a public data set: `python -m toftrack.evaluate`."""

import sys

from toftrack.programs import command_line
from toftrack.programs.evaluate import main

if __name__ == "__main__":
    sys.exit(command_line.run(main))
