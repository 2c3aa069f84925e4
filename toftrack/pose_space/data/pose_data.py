"""Poses to learn from, whatever their source: the paper's 79, recorded motion, a user's file."""

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
from toftrack.pose_space.data.training_poses import synthetic_training_poses

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


@functools.cache
def natural_poses() -> Tensor:
    """(1600, 21) radians: the recorded poses and as many that were drawn."""
    return torch.cat((recorded_poses(), _kept("sampled_rad")))


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


def synthetic_data() -> PoseData:
    """The paper's 79 poses; each transformation and each thumb configuration is a clip."""
    poses = synthetic_training_poses()
    names = list(dict.fromkeys(poses.labels))
    clips = torch.tensor([names.index(label) for label in poses.labels])
    source = {"data": "synthetic", "poses": len(poses.labels)}
    return PoseData(poses.angles_rad, poses.labels, clips, (source,))


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
