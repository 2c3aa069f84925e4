"""What the pose network says of a crop's pixels: the hand's, its forearm's, a thing's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from toftrack.detector.crops import CROP_M
from toftrack.detector.network import PARTS, SEGMENTS

BACKGROUND_PART, HAND_PART, FOREARM_PART, ANOTHER_PART, THING_PART = range(SEGMENTS)
"""Of the classes, see network.SEGMENTS."""
_MIRROR = np.array([-1.0, 1.0, 1.0])


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
        points = points_m * _MIRROR if self.mirrored else points_m
        away = (points @ self.turn).T
        distance = float(np.linalg.norm(self.centre_m))
        across, down = away[:2] * (distance / CROP_M) / np.maximum(away[2], 1e-6) + 0.5
        column, row = (np.floor(PARTS * side).astype(int) for side in (across, down))
        inside = (column >= 0) & (column < PARTS) & (row >= 0) & (row < PARTS)
        inside &= np.abs(away[2] - distance) < CROP_M / 2
        kind = self.kind[np.where(inside, row, 0), np.where(inside, column, 0)]
        return np.where(inside, kind, outside)


ALL_HAND = Parts(
    np.full((PARTS, PARTS), HAND_PART, np.uint8), np.eye(3), np.array([0.0, 0.0, 1.0]), False
)
"""Where nobody says what belongs to the hand."""


def likeliest_parts(painted: np.ndarray) -> np.ndarray:
    """(PARTS, PARTS) classes of a crop, of PoseNet.features' third output (4 classes, 16, 16)."""
    likeliest = painted.reshape(-1, 2, 2, PARTS // 2, PARTS // 2).argmax(0)
    kind: np.ndarray = likeliest.transpose(2, 0, 3, 1).reshape(PARTS, PARTS).astype(np.uint8)
    return kind
