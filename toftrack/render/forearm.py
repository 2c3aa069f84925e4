"""What an image says of a hand's forearm.

A hand hangs on an arm, and the arm goes on until the image ends. The silhouette of a hand with its
forearm looks much like that of a hand the other way round. But there the arm would have to be where
the fingers end, and the image shows the background; or the fingers would be where the arm leaves
the image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from toftrack.render.segmentation import Observation

_ALONG_M = np.array((0.0, 0.05, 0.07, 0.09), np.float32)
"""Points of the forearm's axis, from the wrist, which is the first one."""
_BENT = 0.7
"""The wrist bends: the arm may be this far beside the axis, in parts of the way from the wrist."""
_BEHIND_M = 0.06
"""What lies less than this behind the axis may be the arm."""
_NEAREST_M = 0.05
_EXITS = 64
"""Points at most where the blob leaves the image."""
_KEPT = 4
"""Observations: a frame asks for the same sight where sides are compared and where it chooses."""


@dataclass(frozen=True)
class ArmSight:
    """What an image says of arms.

    depth_m: (H, W) Z, 0 where there is no reading, which may be a dark sleeve.
    gap_px: (H, W) distance to the nearest pixel that is not background.
    exits_m: (E, 3) points where the blob leaves the image.
    k: (3, 3).
    """

    depth_m: np.ndarray
    gap_px: np.ndarray
    exits_m: np.ndarray
    k: np.ndarray


@lru_cache(maxsize=_KEPT)
def arm_sight(observation: Observation) -> ArmSight:
    """Prepare an image for `forearm_conflict`."""
    depth, k = observation.depth_m.numpy(), observation.k.numpy()
    hand = observation.hand.numpy()
    background = ~(hand | observation.occluder.numpy()) & (depth > 0)
    if observation.other is not None:
        background &= ~observation.other.numpy()
    gap = cv2.distanceTransform(background.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    border = np.zeros_like(hand)
    border[[0, -1], :] = border[:, [0, -1]] = True
    v, u = np.nonzero(hand & border)
    some = slice(None, None, max(1, -(-len(v) // _EXITS)))
    v, u = v[some], u[some]
    z = depth[v, u]
    x, y = (u - k[0, 2]) / k[0, 0] * z, (v - k[1, 2]) / k[1, 1] * z
    return ArmSight(depth, gap, np.stack((x, y, z), 1).astype(np.float32), k)


def forearm_conflict(wrist_m: np.ndarray, rotvec: np.ndarray, sight: ArmSight) -> np.ndarray:
    """How much of a hand's forearm cannot be, (N,), 0 to 1.

    It is the share of the forearm where the image shows the background instead; and 1 where a blob
    that leaves the image does so only on the side of the fingers, though the wrist is in view.

    wrist_m, rotvec: (N, 3) translations and rotation vectors.
    """
    axis = _second_axis(rotvec)  # from the fingers to the arm
    points = wrist_m[:, None] + _ALONG_M[:, None] * axis[:, None]  # (N, 4, 3)
    k, z = sight.k, np.maximum(points[..., 2], _NEAREST_M)
    u = np.rint(k[0, 0] * points[..., 0] / z + k[0, 2])
    v = np.rint(k[1, 1] * points[..., 1] / z + k[1, 2])
    height, width = sight.depth_m.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    row, column = np.where(inside, v, 0).astype(np.intp), np.where(inside, u, 0).astype(np.intp)
    behind = sight.depth_m[row, column] > z + _BEHIND_M
    clear = sight.gap_px[row, column] > _BENT * _ALONG_M * k[0, 0] / z
    through: np.ndarray = (inside & behind & clear)[:, 1:].mean(1, dtype=np.float32)
    if len(sight.exits_m) == 0:
        return through
    farthest = (axis @ sight.exits_m.T).max(1) - (axis * wrist_m).sum(1)
    return np.maximum(through, (inside[:, 0] & (farthest < 0)).astype(np.float32))


def _second_axis(rotvec: np.ndarray) -> np.ndarray:
    """(N, 3) second columns of the rotation matrices of rotation vectors (N, 3), by Rodrigues."""
    angle = np.sqrt(np.square(rotvec).sum(1, keepdims=True))
    x, y, z = (rotvec / np.maximum(angle, 1e-9)).T
    sine, cosine = np.sin(angle[:, 0]), np.cos(angle[:, 0])
    rest = y * (1 - cosine)
    return np.stack((x * rest - z * sine, y * rest + cosine, z * rest + x * sine), 1)
