"""The old name of a program: says the new one."""

import sys

from toftrack.configuration.renamed import program_answer

if __name__ == "__main__":
    sys.exit(f"error: {program_answer('train_relocaliser')}")
