"""`python -m toftrack.training COMMAND`: trains, exports and fits; see docs/detector.md."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from toftrack.programs.applications import start
from toftrack.programs.command_line import plain_parser, run

_PROGRAM = "python -m toftrack.training"
_TRAIN = f"""Trains the networks that find hands and propose poses, from nothing.

  {_PROGRAM} train                     hours on two cores, half an hour on 16 and a GPU
  {_PROGRAM} train seed=1              settings are KEY=VALUE
  {_PROGRAM} train resume=FOLDER       continues an interrupted training, by its output folder
  {_PROGRAM} train --cfg job           all settings, composed
  {_PROGRAM} train --hydra-help        further options

conf/train_detector.yaml lists the settings and says what each does."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command line, by default this process's. Raises ToftrackError."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if given[:1] == ["train"] and not {"-h", "--help"}.intersection(given):
        from toftrack.training.train import train

        start(train, f"{_PROGRAM} train", "train_detector", given[1:])
        return
    asked = _parser().parse_args(given)
    if asked.command == "export":
        from toftrack.detector.weights import DEFAULT_FILE
        from toftrack.training.onnx_export import export_networks

        for file in export_networks(asked.weights or DEFAULT_FILE, not asked.float):
            print(f"  {file} ({file.stat().st_size / 1e6:.1f} MB)")
    else:
        from toftrack.training.fit_confidence import fit_confidence

        fit_confidence(asked)


def _parser() -> argparse.ArgumentParser:
    parser = plain_parser(_PROGRAM, "Train the detector's networks, export them, fit confidences.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)

    def command(name: str, about: str, **more: Any) -> Callable[..., Any]:
        """Adds arguments to a new command."""
        return commands.add_parser(name, help=about, **{"description": about} | more).add_argument

    command(
        "train",
        "train the networks from nothing",
        description=_TRAIN,
        usage=f"{_PROGRAM} train [KEY=VALUE ...]",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = command("export", "convert weights to files for ONNX Runtime, beside them")
    add("weights", nargs="?", type=Path, metavar="FILE", help="of `train` (default: the package's)")
    add("--float", action="store_true", help="in floating point, not in 8 bits")
    add = command("fit-confidence", "fit lost=calibrated and write the file for lost.fitted")
    add("overrides", nargs="*", help="settings of the tracker, as for track.py")
    add("--sequences", type=int, default=200, help="how many to render (200)")
    add("--frames", type=int, default=50, help="frames of each sequence (50)")
    add("--seed", type=int, default=1, help="seed of everything random (1)")
    add("--output", type=Path, default=Path("confidence"), help="folder to write into (confidence)")
    return parser


if __name__ == "__main__":
    sys.exit(run(main))
