"""A hand as Biovision hierarchy: a text of bones, and their angles in every frame.

Centimetres and degrees; x right, y up, z backward. A bone has one length, so the hand is as large
as it was at the end of the run. The format cannot say that a hand is lost: the pose is held then.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from toftrack.hand.openxr import OPENXR_JOINT_NAMES, OPENXR_PARENTS
from toftrack.output.exports.motion import HandMotion

_CM = 100.0
_ROTATIONS = "Zrotation Xrotation Yrotation"
_LEFT_OUT = ("palm",)
"""It does not move by itself."""


def bvh_of(motion: HandMotion) -> str:
    """The content of a .bvh file."""
    lines = ["HIERARCHY"]
    order: list[int] = []
    _describe(OPENXR_JOINT_NAMES.index("wrist"), 0, motion, lines, order)
    seconds = float(np.median(np.diff(motion.time_s))) if len(motion.time_s) > 1 else 1 / 25
    lines += ["MOTION", f"Frames: {len(motion.time_s)}", f"Frame Time: {seconds:.6f}"]
    rotations = Rotation.from_quat(motion.turn[:, order].reshape(-1, 4)).as_euler(
        "ZXY", degrees=True
    )
    angles = np.unwrap(rotations.reshape(len(motion.time_s), -1), axis=0, period=360)
    rows = np.concatenate((_CM * motion.offset_m[:, order[0]], angles), 1)
    lines += [" ".join(f"{value:.4f}" for value in row) for row in rows]
    return "\n".join(lines) + "\n"


def _describe(
    joint: int, depth: int, motion: HandMotion, lines: list[str], order: list[int]
) -> None:
    """Append a joint's part of the hierarchy and all below it, and its number to the order."""
    indent = "  " * depth
    children = [
        child
        for child, parent in enumerate(OPENXR_PARENTS)
        if parent == joint and OPENXR_JOINT_NAMES[child] not in _LEFT_OUT
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
