"""Derive from the detector's weights the files that ONNX Runtime runs, beside them:

python -m toftrack.programs.export_detector FILE

train_detector does so at its end. The networks compute in whole numbers of 8 bits, or, with
--float, in floating point, which is slower. Without FILE: those of the package. It needs
`pip install 'toftrack[train]'`; tracking does not.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from toftrack.programs import command_line


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line, write NAME.pose.onnx and NAME.finder.onnx. Raises ToftrackError."""
    parser = argparse.ArgumentParser(
        prog="python -m toftrack.programs.export_detector",
        description="Make of the detector's weights the files that ONNX Runtime runs, beside them.",
    )
    parser.add_argument(
        "weights", nargs="?", type=Path, metavar="FILE", help="of train_detector (the package's)"
    )
    parser.add_argument("--float", action="store_true", help="in floating point, not in 8 bits")
    options = parser.parse_args(arguments)

    from toftrack.detector.onnx_export import export_networks
    from toftrack.detector.weights import DEFAULT_FILE

    for file in export_networks(options.weights or DEFAULT_FILE, not options.float):
        print(f"  {file} ({file.stat().st_size / 1e6:.1f} MB)")


if __name__ == "__main__":
    sys.exit(command_line.run(main))
