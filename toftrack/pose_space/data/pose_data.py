"""Poses to learn from, whatever their source: the paper's 79, recorded motion, a user's file.

The 79 (paper, section 2.3, "Diffusion in subspace") are three basic poses (flat palm, fist,
pointing "gun"), the transformations between them, and extra thumb configurations. The paper does
not give the angles; these are the comfortable flexions of the functional range-of-motion literature
(Bain et al., J. Hand Surg. Eur. 40(4), 2015). In a transformation the fingers do not move as one:
the little finger leads and the index follows, and the middle joints run ahead of the knuckles, as
in natural closing (Santello et al., J. Neurosci. 18(23), 1998).

How they are shared out is chosen so that four principal components hold what they hold in the
paper, 97.5 % of the variance within half a point, and reproduce the poses within 3 degrees rms.
Together these ask for a spread of at most 21.2 degrees rms an angle, 3 / sqrt(1 - 0.98). It is
20.3 here, because all fingers move all the time, because the transformations have poses in
proportion to the fingers that move, and because the thumb takes its other configurations during
them. Were they made with the palm, the fist and the gun only, the poses would heap up where fingers
are quite straight or quite bent, with a spread of 24 degrees.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from toftrack.errors import ToftrackError

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
THUMBS = {
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

_DATA = Path(__file__).parents[2] / "data" / "natural_poses.npz"


def _kept(name: str) -> Tensor:
    with np.load(_DATA, allow_pickle=False) as content:
        return torch.from_numpy(content[name].astype(np.float32))


@functools.cache
def recorded_poses() -> Tensor:
    """(800, 21) joint angles of recorded bare hands, radians (see data/README.md)."""
    return _kept("angles_centidegrees") * (math.pi / 18000)


def drawn_poses() -> Tensor:
    """(480, 21) radians, within the joint limits, from which pose spaces are learned."""
    return _kept("space_rad")


CLIP = 80
"""Natural poses in a row that are held out together."""


@dataclass(frozen=True, eq=False)
class PoseData:
    """Hand poses for learning a pose space.

    angles_rad: (M, 21).
    labels: M names: a gesture, a transformation or a clip.
    clips: M numbers; a clip's poses resemble each other, so it is held out as a whole.
    sources: what went in, one dictionary a file or generator, as written into the model.
    notes: sentences about the reading that the user should see.
    """

    angles_rad: Tensor
    labels: tuple[str, ...]
    clips: Tensor
    sources: tuple[dict[str, Any], ...]
    notes: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.labels)

    def rows(self, rows: Tensor) -> PoseData:
        """The poses of some rows, (K,) int64."""
        return PoseData(
            self.angles_rad[rows],
            tuple(self.labels[i] for i in rows.tolist()),
            self.clips[rows],
            self.sources,
        )


def basic_pose(gesture: str, thumb: str | None = None) -> Tensor:
    """Joint angles of a basic pose, (21,) radians float64; `thumb` overrides its thumb."""
    degrees = list(THUMBS[thumb or _BASIC_THUMB[gesture]])
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
    leads = [0.0] * len(THUMBS["out"])
    for finger in _CURLED:
        leads += [_LEAD[finger] + joint for joint in _JOINT_LEAD]
    progress = torch.tensor(leads, dtype=torch.float64).exp() * done
    return torch.lerp(basic_pose(first), basic_pose(second), progress / (progress + 1 - done))


def synthetic_data() -> PoseData:
    """The paper's 79 poses: basic ones, transformations, thumb configurations. Their labels are a
    gesture, "a-b" or "a-b+thumb", and each is a clip.
    """
    poses = [basic_pose(gesture) for gesture in GESTURES]
    labels = list(GESTURES)
    for (first, second), steps in _TRANSFORMATIONS.items():
        for step in range(1, steps + 1):
            poses.append(_transformation(first, second, step / (steps + 1)))
            labels.append(f"{first}-{second}")
    for first, second, done, thumbs in _THUMB_CONFIGURATIONS:
        for thumb in thumbs:
            pose = _transformation(first, second, done)
            pose[: len(THUMBS[thumb])] = basic_pose(first, thumb)[: len(THUMBS[thumb])]
            poses.append(pose)
            labels.append(f"{first}-{second}+{thumb}")
    names = list(dict.fromkeys(labels))
    clips = torch.tensor([names.index(label) for label in labels])
    source = {"data": "synthetic", "poses": len(labels)}
    return PoseData(torch.stack(poses), tuple(labels), clips, (source,))


def natural_data(poses: int) -> PoseData:
    """Natural motion: recorded poses and drawn ones of what people show, and the paper's 79.

    poses: at most so many of the recorded and of the drawn ones, picked to cover them.
    """
    parts = {"synthetic": synthetic_data()}
    for name, poses_rad in (("recorded", recorded_poses()), ("sampled", drawn_poses())):
        angles = poses_rad.double()
        source = {"data": "natural", "part": name}
        # Neighbours in time are next to each other among the recorded ones.
        clips = torch.arange(len(angles)) // CLIP
        parts[name] = PoseData(angles, (name,) * len(angles), clips, (source,))
    return mixed_data(parts, poses)


def mixed_data(parts: dict[str, PoseData], poses: int | None) -> PoseData:
    """Several sources together.

    poses: at most so many of each part, so that a long recording does not drown the others; picked
        to cover it (`spread_out`); None takes all.
    """
    if not parts:
        raise ToftrackError("data.parts is empty; give at least one source of poses")
    chosen, clips, offset = [], [], 0
    for part in parts.values():
        rows = spread_out(part.angles_rad, len(part) if poses is None else poses)
        chosen.append(part.rows(rows))
        clips.append(chosen[-1].clips + offset)
        offset += int(part.clips.max()) + 1
    return PoseData(
        torch.cat([part.angles_rad for part in chosen]),
        tuple(label for part in chosen for label in part.labels),
        torch.cat(clips),
        tuple(source | {"poses": len(part)} for part in chosen for source in part.sources),
        tuple(note for part in parts.values() for note in part.notes),
    )


def spread_out(angles: Tensor, count: int) -> Tensor:
    """Rows that cover a set of poses, (M, 21) to (min(count, M),) ascending.

    Farthest-point sampling (Gonzalez, Theor. Comput. Sci. 38, 1985) from the pose nearest to the
    mean: every pose left out is close to one that stays, however often a recording repeats it.
    """
    if len(angles) <= count:
        return torch.arange(len(angles))
    nearest = (angles - angles.mean(0)).square().sum(1)
    rows = [int(nearest.argmin())]
    distance = (angles - angles[rows[0]]).square().sum(1)
    while len(rows) < count:
        rows.append(int(distance.argmax()))
        distance = torch.minimum(distance, (angles - angles[rows[-1]]).square().sum(1))
    return torch.tensor(sorted(rows))
