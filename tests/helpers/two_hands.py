"""Recordings of two hands: one and its mirror image, merged by depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from helpers.tracking import Scene


@dataclass(frozen=True, eq=False)
class TwoHands:
    """depth_m: (T, H, W).  k: (3, 3).  joints_m: (2, T, 21, 3), right hand first."""

    depth_m: np.ndarray
    k: np.ndarray
    joints_m: np.ndarray


def beside_its_mirror(
    scene: Scene, shift_px: int, later: int = 0, farther: float = 1.0
) -> TwoHands:
    """A right hand's recording and its mirror image, whose principal point is the same.

    shift_px: the mirrored image is moved so far to the right, as by a shear along the depth.
    later: frames that the mirrored hand is ahead.  farther: and as much larger and farther away.
    """
    other = scene.mirrored().scaled(farther)
    depth = np.roll(other.depth_m, -later, 0)
    joints = np.roll(other.joints_m, -later, 0).copy()
    moved = np.zeros_like(depth)
    columns = round(scene.k[0, 2] - other.k[0, 2]) + shift_px
    moved[:, :, max(0, columns) :] = depth[:, :, : depth.shape[2] - max(0, columns)]
    joints[..., 0] += (other.k[0, 2] - scene.k[0, 2] + columns) / scene.k[0, 0] * joints[..., 2]
    nearer = (scene.depth_m > 0) & ((moved == 0) | (scene.depth_m < moved))
    merged = np.where(nearer, scene.depth_m, moved).astype(np.float32)
    return TwoHands(merged, scene.k, np.stack((scene.joints_m, joints)))
