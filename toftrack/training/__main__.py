"""`python -m toftrack.training COMMAND`: trains, exports and fits; see docs/detector.md."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from toftrack.programs import command_line
from toftrack.programs.applications import start

_PROGRAM = "python -m toftrack.training"
_HELP = ("-h", "--help")
_TRAIN = f"""Trains the networks that find hands and propose poses, from nothing.

  {_PROGRAM} train                     hours on two cores, minutes on a GPU
  {_PROGRAM} train seed=1              settings are KEY=VALUE
  {_PROGRAM} train resume=FOLDER       an interrupted training, by its output folder
  {_PROGRAM} train --cfg job           all settings, composed
  {_PROGRAM} train --hydra-help        further options

conf/train_detector.yaml has the settings, each with what it does."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command line, by default this process's. Raises ToftrackError."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if given[:1] == ["train"] and not set(given).intersection(_HELP):
        from toftrack.training.train import train

        start(train, f"{_PROGRAM} train", "train_detector", given[1:])
        return
    asked = _parser().parse_args(given)
    if asked.command == "export":
        _export(asked)
    elif asked.command == "fit-confidence":
        from toftrack.training.fit_confidence import fit_confidence

        fit_confidence(asked)
    else:
        from toftrack.training.fit_joint_flags import fit_joint_flags

        fit_joint_flags(asked)


def _export(asked: argparse.Namespace) -> None:
    from toftrack.detector.weights import DEFAULT_FILE
    from toftrack.training.onnx_export import export_networks

    for file in export_networks(asked.weights or DEFAULT_FILE, not asked.float):
        print(f"  {file} ({file.stat().st_size / 1e6:.1f} MB)")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_PROGRAM, description="Train the detector's networks, export them, fit the confidence."
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    commands.add_parser(
        "train",
        help="train the networks from nothing",
        usage=f"{_PROGRAM} train [KEY=VALUE ...]",
        description=_TRAIN,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )

    about = "make of weights the files that ONNX Runtime runs, beside them"
    export = commands.add_parser("export", help=about, description=f"{about}; training does so.")
    export.add_argument(
        "weights", nargs="?", type=Path, metavar="FILE", help="of weights (the package's)"
    )
    export.add_argument("--float", action="store_true", help="in floating point, not in 8 bits")

    about = "fit lost=calibrated on rendered sequences: writes the file of lost.fitted"
    confidence = commands.add_parser("fit-confidence", help=about, description=about)
    confidence.add_argument(
        "overrides", nargs="*", default=[], help="of the tracker, as for track.py"
    )
    confidence.add_argument(
        "--sequences", type=int, default=200, help="how many are rendered (200)"
    )
    confidence.add_argument("--frames", type=int, default=50, help="of each (50)")
    confidence.add_argument("--seed", type=int, default=1, help="of everything random (1)")
    confidence.add_argument(
        "--output", type=Path, default=Path("confidence"), help="folder (confidence)"
    )
    confidence.add_argument(
        "--sequences-from",
        type=Path,
        metavar="FOLDER",
        help="track the sequences that an earlier run kept here, or render and keep them",
    )

    flags = commands.add_parser(
        "fit-joint-flags",
        help="choose lost.joint_ok on recordings with truth",
        description="Choose lost.joint_ok on every second recording of each folder, show it on the"
        " others, and print it.",
    )
    flags.add_argument("recordings", nargs="+", help=".npz files or folders of them, with truth")
    flags.add_argument(
        "--labels", action="append", default=[], metavar="FILE", help="of images without truth"
    )
    flags.add_argument("--seeds", type=int, default=1, help="how many runs of each (1)")
    flags.add_argument(
        "--right", type=float, default=4.0, help="per cent of the right tips to be flagged (4)"
    )
    flags.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="settings")
    return parser


if __name__ == "__main__":
    sys.exit(command_line.run(main))
