"""What the pose network says of a crop's pixels: the hand's, its forearm's, a thing's."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from toftrack.compute.compiling import entry_point
from toftrack.detector.crops import CROP_M
from toftrack.detector.network import PARTS, SEGMENTS

BACKGROUND_PART, HAND_PART, FOREARM_PART, ANOTHER_PART, THING_PART = range(SEGMENTS)
"""Of the classes, see network.SEGMENTS."""


@dataclass(frozen=True, eq=False)
class Parts:
    """The likeliest class of each part of a crop.

    kind: (PARTS, PARTS).  turn, centre_m: (3, 3), (3,) of the crop, see crops.crop.
    mirrored: they are of the mirrored image.
    """

    kind: np.ndarray
    turn: np.ndarray
    centre_m: np.ndarray
    mirrored: bool

    def at(self, points_m: np.ndarray, outside: int = BACKGROUND_PART) -> np.ndarray:
        """(P,) classes of seen points (P, 3), camera frame; `outside` where the crop ends."""
        points = np.ascontiguousarray(points_m, np.float64)
        found = np.empty(len(points), np.uint8)
        crop = self.kind, np.ascontiguousarray(self.turn), self.centre_m, self.mirrored
        _classes(points, *crop, np.uint8(outside), found)
        return found


@entry_point
def _classes(points, kind, turn, centre, mirrored, outside, found):
    """See Parts.at; points: (P, 3) float64, found: (P,) uint8."""
    parts = kind.shape[0]
    distance = math.sqrt(centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2)
    for p in range(len(points)):
        x, y, z = -points[p, 0] if mirrored else points[p, 0], points[p, 1], points[p, 2]
        across = x * turn[0, 0] + y * turn[1, 0] + z * turn[2, 0]
        down = x * turn[0, 1] + y * turn[1, 1] + z * turn[2, 1]
        away = x * turn[0, 2] + y * turn[1, 2] + z * turn[2, 2]
        scale = distance / CROP_M / max(away, 1e-6)
        column, row = parts * (across * scale + 0.5), parts * (down * scale + 0.5)
        found[p] = outside
        inside = 0 <= column < parts and 0 <= row < parts
        if inside and abs(away - distance) < CROP_M / 2:
            found[p] = kind[int(row), int(column)]


ALL_HAND = Parts(
    np.full((PARTS, PARTS), HAND_PART, np.uint8), np.eye(3), np.array([0.0, 0.0, 1.0]), False
)
"""Where nobody says what belongs to the hand."""


def likeliest_parts(painted: np.ndarray) -> np.ndarray:
    """(PARTS, PARTS) classes of a crop, of PoseNet.features' third output (4 classes, 16, 16)."""
    likeliest = painted.reshape(-1, 2, 2, PARTS // 2, PARTS // 2).argmax(0)
    kind: np.ndarray = likeliest.transpose(2, 0, 3, 1).reshape(PARTS, PARTS).astype(np.uint8)
    return kind
