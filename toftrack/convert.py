"""Convert a recording: `python -m toftrack.convert`."""

import sys

from toftrack.programs import command_line
from toftrack.programs.convert import main

if __name__ == "__main__":
    sys.exit(command_line.run(main))
