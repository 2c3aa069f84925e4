"""The 79 synthetic training poses (paper, section 2.3, "Diffusion in subspace").

Three basic poses (flat palm, fist, pointing "gun"), the transformations between them, and extra
thumb configurations. The paper does not give the angles; these are the comfortable flexions of
the functional range-of-motion literature (Bain et al., J. Hand Surg. Eur. 40(4), 2015). In a
transformation the fingers do not move as one: the little finger leads and the index follows, and
the middle joints run ahead of the knuckles, as in natural closing (Santello et al., J. Neurosci.
18(23), 1998).

How the 79 are shared out is chosen so that four principal components hold what they hold in the
paper, 97.5 % of the variance within half a point, and reproduce the poses within 3 degrees rms.
Together these ask for a spread of at most 21.2 degrees rms an angle, 3 / sqrt(1 - 0.98). It is
20.3 here, because all fingers move all the time, because the transformations have poses in
proportion to the fingers that move, and because the thumb takes its other configurations during
them. Were they made with the palm, the fist and the gun only, the poses would heap up where fingers
are quite straight or quite bent, with a spread of 24 degrees.
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

# Poses strictly between two basic ones, about in proportion to the four, three or one fingers that
# move: 3 + 30 + 20 + 10 + 16 thumb configurations = 79.
_TRANSFORMATIONS = {("palm", "fist"): 30, ("palm", "gun"): 20, ("gun", "fist"): 10}
# How far ahead of the middle finger, and of the finger's last joint, a joint runs: the logarithm of
# the factor of (part done) / (part to do).
_LEAD = {"index": -0.4, "middle": 0.0, "ring": 0.2, "little": 0.4}
_JOINT_LEAD = (0.0, -0.8, 0.4, 0.0)  # abduction, knuckle, middle joint, last joint
_THUMB_CONFIGURATIONS = (
    # transformation, the part of it that is done, thumbs
    ("palm", "fist", 0.2, ("up", "beside", "across", "tucked", "hooked")),
    ("palm", "fist", 0.5, ("up", "beside", "across", "tucked", "hooked")),
    ("palm", "gun", 0.5, ("up", "beside", "across")),
    ("gun", "fist", 0.5, ("out", "beside", "tucked")),
)


class TrainingPoses(NamedTuple):
    """angles_rad: (79, 21).  labels: a gesture, "a-b" for a transformation, "a-b+thumb"."""

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


def _transformation(first: str, second: str, done: float) -> Tensor:
    """The pose when the part `done`, 0 .. 1, of the way between two basic poses is done, (21,).

    Each angle's part done has the odds of `done` times its own lead: it moves all the time, and
    from end to end.
    """
    leads = [0.0] * len(_THUMB["out"])
    for finger in _CURLED:
        leads += [_LEAD[finger] + joint for joint in _JOINT_LEAD]
    progress = torch.tensor(leads, dtype=torch.float64).exp() * done
    return torch.lerp(basic_pose(first), basic_pose(second), progress / (progress + 1 - done))


def synthetic_training_poses() -> TrainingPoses:
    """The paper's 79 poses, in the order basic poses, transformations, thumb configurations."""
    poses = [basic_pose(gesture) for gesture in GESTURES]
    labels = list(GESTURES)
    for (first, second), steps in _TRANSFORMATIONS.items():
        for step in range(1, steps + 1):
            poses.append(_transformation(first, second, step / (steps + 1)))
            labels.append(f"{first}-{second}")
    for first, second, done, thumbs in _THUMB_CONFIGURATIONS:
        for thumb in thumbs:
            pose = _transformation(first, second, done)
            pose[: len(_THUMB[thumb])] = basic_pose(first, thumb)[: len(_THUMB[thumb])]
            poses.append(pose)
            labels.append(f"{first}-{second}+{thumb}")
    return TrainingPoses(torch.stack(poses), tuple(labels))
