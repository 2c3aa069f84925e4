"""Record what an SR3000 sends: `python -m toftrack.record`."""

import sys

from toftrack.programs import command_line
from toftrack.programs.record import main

if __name__ == "__main__":
    sys.exit(command_line.run(main))
