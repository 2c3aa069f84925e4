"""Recorded hand motion: joint positions of a Leap Motion sensor, as joint angles of our skeleton.

The format: an .npz with `joints_mm` (T, 5 fingers, 4 joints, 3) millimetres, fingers from the
thumb, joints from the root to the tip; `is_left` (T,) bool; `seq_name` and `seq_len`, the clips one
after another.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.archives import read_archive
from toftrack.hand.shape import default_hand_shape
from toftrack.pose_space.data.pose_data import PoseData, spread_out
from toftrack.pose_space.inverse_kinematics import (
    fit_angles,
    shape_of_joints,
    straight_finger_directions,
)

_SAME_MM = 1.0
"""Frames whose joints differ less than this about the hand's middle are the same frame."""


def leap_data(path: str, poses: int | None, worst_fit_mm: float) -> PoseData:
    """Joint angles of recorded joint positions.

    1. Left hands are mirrored (x -> -x).
    2. Clips that repeat another's frames (resamplings, excerpts) are found by comparing the frames
       themselves; of each family only the longest clip stays.
    3. Inverse kinematics, a hand of its own size and bones a clip (`fit_angles`).
    4. Frames that our skeleton cannot follow are dropped, and of what is left `poses` that cover
       it are kept: a sensor of 110 frames a second mostly repeats itself.

    poses: at most so many; None keeps all.
    worst_fit_mm: frames whose mean joint error is above are dropped.
    """
    joints_mm, left, names, lengths = _read(path)
    joints = torch.from_numpy(joints_mm).double() / 1e3
    joints[left] *= torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    clips = list(torch.split(joints, lengths))
    family = clip_families(clips)
    kept = [
        max((i for i, other in enumerate(family) if other == f), key=lambda i: lengths[i])
        for f in dict.fromkeys(family)
    ]

    shape = default_hand_shape().to(torch.float64)
    directions = torch.stack([straight_finger_directions(clips[i], shape) for i in kept]).sum(0)
    yaw = math.atan2(float(directions[0]), float(directions[1]))
    what = f"the joint positions of {path} do not make a hand"
    with reported_errors(what, "are they in millimetres?", torch.linalg.LinAlgError):
        fits = [fit_angles(clips[i], shape_of_joints(clips[i], shape, yaw)) for i in kept]
    angles = torch.cat([fit.angles_rad for fit in fits])
    error_mm = 1e3 * torch.cat([fit.error_m for fit in fits])
    followed = error_mm.mean(1) <= worst_fit_mm
    if not bool(followed.any()):
        raise ToftrackError(
            f"the hand skeleton fits no frame of {path} within {worst_fit_mm:g} mm; are the"
            " positions in millimetres, fingers from the thumb and joints from the root?"
        )
    owner = torch.cat([torch.full((len(clips[i]),), n) for n, i in enumerate(kept)])
    angles, owner = angles[followed], owner[followed]
    rows = spread_out(angles, poses or len(angles))
    fit = {
        "fit_mean_mm": round(float(error_mm.mean()), 2),
        "fit_p95_mm": round(float(error_mm.quantile(0.95)), 2),
    }
    clips_kept = [names[i] for i in kept]
    source = {"data": "leap", "file": Path(path).name, "clips": clips_kept, "poses": len(rows)}
    notes = (
        f"{Path(path).name}: {len(kept)} of {len(clips)} clips"
        f" ({len(clips) - len(kept)} repeat another), {int(left.sum())} of {len(joints)} frames"
        " mirrored from left hands",
        f"inverse kinematics: joints {fit['fit_mean_mm']:.2f} mm off on average, 95 % below"
        f" {fit['fit_p95_mm']:.1f} mm; {int((~followed).sum())} of {len(followed)} frames dropped"
        f" (mean above {worst_fit_mm:g} mm); {len(rows)} poses that cover the rest",
    )
    labels = tuple(names[kept[n]] for n in owner[rows].tolist())
    return PoseData(angles[rows], labels, owner[rows], (source | fit,), notes)


def clip_families(clips: list[Tensor]) -> list[int]:
    """Which clips repeat one another: a family number a clip.

    clips: each (T, 5, 4, 3) metres. Two belong together when at least half of the frames of the
    shorter are within _SAME_MM of a frame of the other, moved to a common middle.
    """
    flat = [(c - c.mean((1, 2), keepdim=True)).flatten(1).float() for c in clips]
    limit = _SAME_MM / 1e3 * math.sqrt(20)
    family = list(range(len(clips)))
    for i in range(len(clips)):
        for j in range(i):
            short, long = sorted((flat[i], flat[j]), key=len)
            same = torch.cdist(short, long).amin(1) < limit
            if float(same.float().mean()) >= 0.5:
                old, new = family[i], family[j]
                family = [new if f == old else f for f in family]
    return family


def _read(path: str) -> tuple[np.ndarray, np.ndarray, list[str], list[int]]:
    expected = (OSError, KeyError, ValueError, TypeError, OverflowError)
    remedy = (
        "give data.path=FILE of joints_mm, is_left, seq_name and seq_len; data=file reads angles"
    )
    with reported_errors(f"{path} cannot be read as a file of recorded joints", remedy, *expected):
        content = read_archive(path)
        joints = content["joints_mm"]
        if joints.dtype.kind not in "fiu":
            raise ValueError(f"joints_mm is of type {joints.dtype}, and no real numbers")
        joints = joints.astype(np.float32)
        left = np.asarray(content["is_left"], bool)
        names = [str(name) for name in content["seq_name"]]
        lengths = [int(length) for length in content["seq_len"]]
        shapes = joints.shape[1:] == (5, 4, 3) and left.shape == joints.shape[:1]
        counted = len(names) == len(lengths) and joints.shape[:1] == (sum(lengths),)
        if not shapes or not counted or min(lengths, default=0) < 1:
            raise ValueError(
                f"joints_mm {joints.shape}, is_left {left.shape}, {len(names)} clips of"
                f" {sum(lengths)} frames together"
            )
        if not np.isfinite(joints).all():
            raise ValueError("joint positions are NaN or infinite")
    return joints, left, [name.removesuffix(".json.lz") for name in names], lengths
