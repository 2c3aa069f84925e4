"""Pictures of a finished run: `python -m toftrack.figures`."""

import sys

from toftrack.programs import command_line
from toftrack.programs.figures import main

if __name__ == "__main__":
    sys.exit(command_line.run(main))
