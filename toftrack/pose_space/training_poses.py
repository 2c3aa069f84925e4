"""The 79 synthetic training poses (paper, section 2.3, "Diffusion in subspace").

Three basic poses (flat palm, fist, pointing "gun"), the transformations between them, and extra
thumb configurations. The paper does not give the angles; these are the comfortable flexions of
the functional range-of-motion literature (Bain et al., J. Hand Surg. Eur. 40(4), 2015). In a
transformation the fingers do not move as one: the little finger leads and the index follows, and
the middle joints run ahead of the knuckles, as in natural closing (Santello et al., J. Neurosci.
18(23), 1998).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

GESTURES = ("palm", "fist", "gun")

# Degrees, in the order of hand.skeleton.ANGLE_NAMES.
_STRAIGHT = (0, 0, 0, 0)
_CURLED = {
    "index": (0, 88, 100, 50),
    "middle": (0, 90, 102, 50),
    "ring": (0, 90, 102, 50),
    "little": (0, 90, 100, 50),
}
_SPREAD = {"index": 2, "middle": 0, "ring": -2, "little": -4}
_THUMB = {
    "out": (4, 2, 5, -8, -8),
    "up": (35, -8, 5, -10, -5),
    "beside": (-30, 5, -8, 10, 10),
    "across": (0, 42, -20, 30, 28),
    "tucked": (-12, 35, -15, 55, 60),
    "hooked": (4, 2, 5, 25, 60),
}
_BASIC_THUMB = {"palm": "out", "fist": "across", "gun": "out"}

_STEPS = 20  # poses strictly between two basic ones: 3 + 3 x 20 + 16 thumb configurations = 79
# How far ahead of the middle finger, and of the knuckle's neighbours, a joint runs (parts of the
# transformation).
_LEAD = {"thumb": 0.0, "index": -0.15, "middle": 0.0, "ring": 0.09, "little": 0.15}
_JOINT_LEAD = (0.0, -0.15, 0.10, 0.05)  # abduction, knuckle, middle joint, last joint
_THUMB_CONFIGURATIONS = (
    *(
        ("palm", name, part)
        for name in ("up", "beside", "across", "tucked", "hooked")
        for part in (0.5, 1.0)
    ),
    *(("gun", name, 1.0) for name in ("up", "beside", "across")),
    *(("fist", name, 1.0) for name in ("out", "beside", "tucked")),
)


class TrainingPoses(NamedTuple):
    """angles_rad: (79, 21).  labels: a gesture, "a-b" for a transformation, "gesture+thumb"."""

    angles_rad: Tensor
    labels: tuple[str, ...]


def basic_pose(gesture: str, thumb: str | None = None) -> Tensor:
    """Joint angles of a basic pose, (21,) radians float64; `thumb` overrides its thumb."""
    degrees = list(_THUMB[thumb or _BASIC_THUMB[gesture]])
    for finger, curled in _CURLED.items():
        straight = gesture == "palm" or (gesture == "gun" and finger == "index")
        pose = _STRAIGHT if straight else curled
        degrees += [pose[0] + (_SPREAD[finger] if straight else 0), *pose[1:]]
    return torch.tensor(degrees, dtype=torch.float64) * (math.pi / 180)


def _transformation(a: Tensor, b: Tensor, step: float) -> Tensor:
    """The pose at `step` in 0 .. 1 of the way from a to b, (21,) each.

    Each angle runs linearly through its own window of the transformation and rests outside it; the
    windows of the angles that move at all span the transformation from end to end.
    """
    leads = [_LEAD["thumb"]] * 5
    for finger in _CURLED:
        leads += [_LEAD[finger] + joint for joint in _JOINT_LEAD]
    lead = torch.tensor(leads, dtype=torch.float64)
    first, last = lead[a != b].max(), lead[a != b].min()
    progress = step * (1 + first - last) - (first - lead)
    return torch.lerp(a, b, progress.clamp(0, 1))


def synthetic_training_poses() -> TrainingPoses:
    """The paper's 79 poses, in the order basic poses, transformations, thumb configurations."""
    poses = [basic_pose(gesture) for gesture in GESTURES]
    labels = list(GESTURES)
    for first, second in (("palm", "fist"), ("palm", "gun"), ("gun", "fist")):
        a, b = basic_pose(first), basic_pose(second)
        for step in range(1, _STEPS + 1):
            poses.append(_transformation(a, b, step / (_STEPS + 1)))
            labels.append(f"{first}-{second}")
    for gesture, thumb, part in _THUMB_CONFIGURATIONS:
        poses.append(torch.lerp(basic_pose(gesture), basic_pose(gesture, thumb), part))
        labels.append(f"{gesture}+{thumb}")
    return TrainingPoses(torch.stack(poses), tuple(labels))
