"""What the pose network says of a crop's pixels: the hand's, its forearm's, a thing's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from toftrack.compute.compiling import compiled, entry_point
from toftrack.detector.crops import CROP_M
from toftrack.detector.network import PARTS, SEGMENTS

BACKGROUND_PART, HAND_PART, FOREARM_PART, ANOTHER_PART, THING_PART = range(SEGMENTS)
"""Of the classes, see network.SEGMENTS."""


@dataclass(frozen=True, eq=False)
class Parts:
    """The likeliest class of each part of a crop.

    kind: (PARTS, PARTS).  turn, centre_m: (3, 3), (3,) of the crop, see crops.crop_at.
    mirrored: they are of the mirrored image.
    """

    kind: np.ndarray
    turn: np.ndarray
    centre_m: np.ndarray
    mirrored: bool

    def at(self, points_m: np.ndarray) -> np.ndarray:
        """(P,) classes of seen points (P, 3), camera frame; background where the crop ends."""
        found = np.empty(len(points_m), np.uint8)
        _classes(np.ascontiguousarray(points_m, np.float64), self._crop, found)
        return found

    def seen(
        self, depth_m: np.ndarray, pixels: np.ndarray, k: np.ndarray, other: int
    ) -> np.ndarray:
        """(H, W) classes of an image's pixels; `other` beyond the crop, and of other pixels.

        depth_m: (H, W) Z, m.  pixels: (H, W) bool.  k: (3, 3).
        """
        found = np.full(depth_m.shape, other, np.uint8)
        _classes_of_pixels(depth_m, pixels, np.asarray(k, np.float64), self._crop, found)
        return found

    @cached_property
    def _crop(self) -> tuple:
        return self.kind, np.ascontiguousarray(self.turn), self.centre_m, self.mirrored


@entry_point
def _classes(points, crop, found):
    """See Parts.at; points: (P, 3) float64, found: (P,) uint8."""
    for p in range(len(points)):
        kind = _class_of(points[p, 0], points[p, 1], points[p, 2], crop)
        found[p] = BACKGROUND_PART if kind < 0 else kind


@entry_point
def _classes_of_pixels(depth, pixels, k, crop, found):
    """See Parts.seen."""
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if pixels[v, u]:
                z = np.float64(depth[v, u])
                x, y = (u - k[0, 2]) / k[0, 0] * z, (v - k[1, 2]) / k[1, 1] * z
                kind = _class_of(x, y, z, crop)
                found[v, u] = found[v, u] if kind < 0 else kind


@compiled
def _class_of(x, y, z, crop):
    """Of a point, camera frame; -1 where the crop ends."""
    kind, turn, centre, mirrored = crop
    parts = kind.shape[0]
    distance = math.sqrt(centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2)
    x = -x if mirrored else x
    across = x * turn[0, 0] + y * turn[1, 0] + z * turn[2, 0]
    down = x * turn[0, 1] + y * turn[1, 1] + z * turn[2, 1]
    away = x * turn[0, 2] + y * turn[1, 2] + z * turn[2, 2]
    scale = distance / CROP_M / max(away, 1e-6)
    column, row = parts * (across * scale + 0.5), parts * (down * scale + 0.5)
    if not (0 <= column < parts and 0 <= row < parts and abs(away - distance) < CROP_M / 2):
        return np.int64(-1)
    return np.int64(kind[int(row), int(column)])


ALL_HAND = Parts(
    np.full((PARTS, PARTS), HAND_PART, np.uint8), np.eye(3), np.array([0.0, 0.0, 1.0]), False
)
"""Where nobody says what belongs to the hand."""


def likeliest_parts(painted: np.ndarray) -> np.ndarray:
    """(PARTS, PARTS) classes of a crop, of PoseNet.features' third output (4 classes, 16, 16)."""
    likeliest = painted.reshape(-1, 2, 2, PARTS // 2, PARTS // 2).argmax(0)
    kind: np.ndarray = likeliest.transpose(2, 0, 3, 1).reshape(PARTS, PARTS).astype(np.uint8)
    return kind
