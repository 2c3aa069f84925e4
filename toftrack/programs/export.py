"""Write a run in a format that other programs open: `toftrack export RUN --to glb`.

glb: an animated hand with a skin, for Blender, Unity, Godot and web pages (needs the extra export).
bvh: its skeleton's motion in centimetres and degrees, x right, y up, z backward, for animation
programs; the hand has the size that hand_shape.json gives, and keeps its pose while lost. csv: a
flat table, for spreadsheets. The file goes into RUN.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from toftrack.errors import reported_errors
from toftrack.files.safe_files import whole_file
from toftrack.hand.openxr import OPENXR_JOINT_NAMES, OPENXR_PARENTS
from toftrack.hand.skeleton import ANGLE_NAMES
from toftrack.output.exports import HandMotion, glb_of, motions_of
from toftrack.output.lines import DROPPED
from toftrack.output.run_folder import read_run
from toftrack.programs.command_line import note, plain_parser


def main(arguments: Sequence[str]) -> None:
    """Parse the command line, write the file, print its name. Raises ToftrackError."""
    parser = plain_parser("toftrack export", __doc__)
    parser.add_argument("run", metavar="RUN", help="the output folder of toftrack track")
    parser.add_argument("--to", required=True, choices=("glb", "bvh", "csv"), help="the format")
    options = parser.parse_args(arguments)
    for path in export(Path(options.run).expanduser(), options.to):
        print(f"  {path}")


def export(folder: Path, kind: str) -> list[Path]:
    """Write a run's folder in a format, glb, bvh or csv; returns the files that were written.

    Raises ToftrackError: the folder is no run's, or has no hand; or the file cannot be written.
    """
    run = read_run(folder)
    contents: dict[str, Iterable[bytes]]
    if kind == "csv":
        contents = {"hand.csv": csv_lines(run.results)}
    else:
        motions = motions_of(run)
        if kind == "glb":
            contents = {"hand.glb": [glb_of(motions)]}
        else:  # a file has one skeleton
            steps_s = np.diff(motions[0].time_s)
            if len(steps_s) and steps_s.max() > _UNEVEN * np.median(steps_s):
                note("frames are not evenly spaced, which a .bvh cannot say")
            slots = {motion.slot: [bvh_of(motion).encode()] for motion in motions}
            several = len(run.shapes) > 1
            contents = {f"hand{slot + 1 if several else ''}.bvh": c for slot, c in slots.items()}
    with reported_errors(f"'{folder}' cannot be written", "copy it to where it can be"):
        for name, content in contents.items():
            with whole_file(folder / name) as stream:
                stream.writelines(content)
    return [folder / name for name in contents]


_CM = 100.0
_UNEVEN = 1.5
"""Times the usual step between frames, beyond which there was a pause."""
_ROTATIONS = "Zrotation Xrotation Yrotation"


def bvh_of(motion: HandMotion) -> str:
    """The content of a .bvh file."""
    lines = ["HIERARCHY"]
    order: list[int] = []
    _describe(OPENXR_JOINT_NAMES.index("wrist"), 0, motion, lines, order)
    steps_s = np.diff(motion.time_s)
    # Not the median alone: of 33 and 34 ms that is 33, and half a minute is missing in an hour.
    usual = steps_s[steps_s <= _UNEVEN * np.median(steps_s)] if len(steps_s) else [1 / 25]
    lines += ["MOTION", f"Frames: {len(motion.time_s)}", f"Frame Time: {np.mean(usual):.9f}"]
    turns = Rotation.from_quat(motion.turn[:, order].reshape(-1, 4)).as_euler("ZXY", degrees=True)
    angles = np.unwrap(turns.reshape(len(motion.time_s), -1), axis=0, period=360)
    rows = np.concatenate((_CM * motion.offset_m[:, order[0]], angles), 1)
    lines += [" ".join(f"{value:.4f}" for value in row) for row in rows]
    return "\n".join(lines) + "\n"


def _describe(
    joint: int, depth: int, motion: HandMotion, lines: list[str], order: list[int]
) -> None:
    """Append a joint's part of the hierarchy and all below it, and its number to the order."""
    indent = "  " * depth
    # The palm is left out, which does not move by itself.
    children = [
        child
        for child, parent in enumerate(OPENXR_PARENTS)
        if parent == joint and OPENXR_JOINT_NAMES[child] != "palm"
    ]
    # The place of the root is a channel.
    offset = _CM * motion.rest_offset_m[joint] if depth else np.zeros(3)
    place = f"{indent}  OFFSET " + " ".join(f"{value:.6f}" for value in offset)
    if not children:
        lines += [f"{indent}End Site", f"{indent}{{", place, f"{indent}}}"]
        return
    order.append(joint)
    channels = f"6 Xposition Yposition Zposition {_ROTATIONS}" if not depth else f"3 {_ROTATIONS}"
    kind = "JOINT" if depth else "ROOT"
    lines += [f"{indent}{kind} {motion.name(OPENXR_JOINT_NAMES[joint])}", f"{indent}{{", place]
    lines.append(f"{indent}  CHANNELS {channels}")
    for child in children:
        _describe(child, depth + 1, motion, lines, order)
    lines.append(f"{indent}}}")


_PLAIN = (
    *("state_name", "lost", "dropped", "confidence", "side", "side_probability", "score"),
    *("outside_rad", "gesture", "gesture_probability", "pinch", "pinching"),
)
_MAIN_AXES = ("ray", "along", "across")  # of hand/regions.py


def csv_lines(results: Mapping[str, Any]) -> Iterator[bytes]:
    """The lines of a .csv file: titles, and a row a frame, or a frame and hand where there are
    several.

    What is unknown (NaN) is an empty cell. results: of a track.npz.
    """
    rows = table_of(results)
    titles = next(rows)
    cells = ([number, f"{time_s:.6f}", *map(_cell, rest)] for number, time_s, *rest in rows)
    for row in chain([titles], cells):
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerow(row)
        yield text.getvalue().encode()


def table_of(results: Mapping[str, Any]) -> Iterator[list[Any]]:
    """The titles of `csv_lines`, and then its rows, with their values as they are."""
    several = np.ndim(results["lost"]) > 1
    slots = np.shape(results["lost"])[1] if several else 1
    joints = results["joint_names"]
    titles = {name: [name] for name in _PLAIN} | {
        "pointing_origin_m": [f"pointing_origin_{axis}_m" for axis in "xyz"],
        "pointing_direction": [f"pointing_direction_{axis}" for axis in "xyz"],
        "joints_m": [f"{joint}_{axis}_m" for joint in joints for axis in "xyz"],
        "joint_ok": [f"{joint}_ok" for joint in joints],
        "state": [f"{angle}_rad" for angle in ANGLE_NAMES],  # the last of its numbers
        "joint_confidence": [f"{joint}_confidence" for joint in joints],
        "joint_sigma_m": [f"{joint}_sigma_{axis}_m" for joint in joints for axis in _MAIN_AXES],
    }
    arrays = {name: np.asarray(results[name]) for name in titles if name in results}
    of_arrays = chain.from_iterable(titles[name] for name in arrays)
    yield ["index", "timestamp_s", *(["slot"] if several else []), *of_arrays]
    index = results.get("index", np.arange(len(results["lost"])))
    for row, number in enumerate(index):
        for slot in range(slots):
            time_s = float(results["timestamp_s"][row])
            cells = [int(number), time_s, *([slot] if several else [])]
            for name, array in arrays.items():
                # A frame is dropped for all of its hands.
                here = (row, slot) if several and name != DROPPED else row
                cells += array[here].ravel().tolist()[-len(titles[name]) :]
            yield cells


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float):
        # 0.0, not 0: readers that look at the first rows alone take whole numbers for the type.
        return str(float(f"{value:.6g}")) if np.isfinite(value) else ""
    return str(value)
