"""Write a run in a format that other programs open: `toftrack export RUN --to glb`.

glb: an animated hand with a skin, for Blender, Unity, Godot and web pages (needs the extra export).
bvh: its skeleton's motion, for animation programs. csv: a flat table, for spreadsheets. The file
goes into RUN.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from toftrack.errors import reported_errors
from toftrack.output.exports.bvh import bvh_of
from toftrack.output.exports.glb import glb_of
from toftrack.output.exports.motion import motions_of
from toftrack.output.exports.table import csv_of
from toftrack.output.run_folder import Run, read_run
from toftrack.programs.command_line import plain_parser
from toftrack.safe_files import write_whole

FORMATS = ("glb", "bvh", "csv")


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line, write the file, print its name. Raises ToftrackError."""
    parser = plain_parser("toftrack export", __doc__)
    parser.add_argument("run", metavar="RUN", help="the output folder of toftrack track")
    parser.add_argument("--to", required=True, choices=FORMATS, help="the format")
    options = parser.parse_args(arguments)
    for path in export(Path(options.run).expanduser(), options.to):
        print(f"  {path}")


def export(folder: Path, kind: str) -> list[Path]:
    """Write a run's folder in a format of FORMATS; returns the files that were written.

    Raises ToftrackError: the folder is no run's, or has no hand; or the file cannot be written.
    """
    contents = _contents(read_run(folder), kind)
    with reported_errors(f"'{folder}' cannot be written", "copy it to where it can be"):
        for name, content in contents.items():
            write_whole(folder / name, content)
    return [folder / name for name in contents]


def _contents(run: Run, kind: str) -> dict[str, bytes]:
    """What each file is to hold, by its name."""
    if kind == "csv":
        return {"hand.csv": csv_of(run.results).encode()}
    motions = motions_of(run.results, run.shapes)
    if kind == "glb":
        return {"hand.glb": glb_of(motions)}
    if len(run.shapes) == 1:
        return {"hand.bvh": bvh_of(motions[0]).encode()}
    # A file has one skeleton.
    return {f"hand{motion.slot + 1}.bvh": bvh_of(motion).encode() for motion in motions}
