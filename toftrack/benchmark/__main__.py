"""`python -m toftrack.benchmark`."""

import sys

from toftrack.benchmark.scoring import main

sys.exit(main())
