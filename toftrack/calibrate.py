"""Calibrate a camera: `python -m toftrack.calibrate`."""

import sys

from toftrack.programs import command_line
from toftrack.programs.calibrate import main

if __name__ == "__main__":
    sys.exit(command_line.run(main))
