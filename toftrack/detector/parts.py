"""What the pose network says of a crop's pixels: the hand's, its forearm's, a thing's."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from toftrack.compute.compiling import entry_point
from toftrack.detector.crops import CROP_M
from toftrack.detector.network import PARTS, SEGMENTS

BACKGROUND_PART, HAND_PART, FOREARM_PART, ANOTHER_PART, THING_PART = range(SEGMENTS)
"""The classes, see network.SEGMENTS."""
UNKNOWN_PART = 255
"""Instead of a class, of what the crop does not show."""


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

    def seen(self, depth_m: np.ndarray, pixels: np.ndarray, k: np.ndarray) -> np.ndarray:
        """(H, W) classes of some pixels of an image; UNKNOWN_PART where the crop does not show
        them, and of all other pixels.

        depth_m: (H, W) Z, m.  pixels: (H, W) bool.  k: (3, 3).
        """
        found = np.full(depth_m.shape, UNKNOWN_PART, np.uint8)
        crop = self.kind, np.ascontiguousarray(self.turn), self.centre_m, self.mirrored
        # A copy: numba compiles once more for an array that must not be written to.
        _classes(depth_m, pixels, np.array(k, np.float64), crop, found)
        return found


@entry_point
def _classes(depth, pixels, k, crop, found):
    """See Parts.seen; what is already in `found` stays where the crop ends."""
    kind, turn, centre, mirrored = crop
    parts = kind.shape[0]
    distance = math.sqrt(centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2)
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if not pixels[v, u]:
                continue
            z = np.float64(depth[v, u])
            x, y = (u - k[0, 2]) / k[0, 0] * z, (v - k[1, 2]) / k[1, 1] * z
            x = -x if mirrored else x
            across = x * turn[0, 0] + y * turn[1, 0] + z * turn[2, 0]
            down = x * turn[0, 1] + y * turn[1, 1] + z * turn[2, 1]
            away = x * turn[0, 2] + y * turn[1, 2] + z * turn[2, 2]
            scale = distance / CROP_M / max(away, 1e-6)
            column, row = parts * (across * scale + 0.5), parts * (down * scale + 0.5)
            if 0 <= column < parts and 0 <= row < parts and abs(away - distance) < CROP_M / 2:
                found[v, u] = kind[int(row), int(column)]


ALL_HAND = Parts(
    np.full((PARTS, PARTS), HAND_PART, np.uint8), np.eye(3), np.array([0.0, 0.0, 1.0]), False
)
"""Where nobody says what belongs to the hand."""


def likeliest_parts(painted: np.ndarray) -> np.ndarray:
    """(PARTS, PARTS) classes of a crop, of PoseNet.features' third output (4 classes, 16, 16)."""
    likeliest = painted.reshape(-1, 2, 2, PARTS // 2, PARTS // 2).argmax(0)
    kind: np.ndarray = likeliest.transpose(2, 0, 3, 1).reshape(PARTS, PARTS).astype(np.uint8)
    return kind
