"""Your own gestures: `python -m toftrack.gesture add NAME RECORDING --from 2.0 --to 3.0`."""

import sys

from toftrack.programs import command_line
from toftrack.programs.gesture import main

if __name__ == "__main__":
    sys.exit(command_line.run(main))
