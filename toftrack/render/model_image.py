"""The range image of an estimate (paper, fig. 3)."""

from __future__ import annotations

import math

import numpy as np
import torch

from toftrack.compute.compiling import compiled, entry_point
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import Ellipsoids, hand_surface, parted
from toftrack.render.scoring import NEAREST_M


def posed_hand(state: np.ndarray, shape: HandShape) -> tuple[Ellipsoids, Ellipsoids]:
    """One posed hand, (1, E) ellipsoids, and its wrist's, (1, 1).  state: (27,), finite.  shape: on
    the CPU."""
    batch = torch.from_numpy(np.asarray(state, np.float32))[None]
    return parted(hand_surface(shape).pose(forward_kinematics(batch, shape)))


def range_image(ellipsoids: Ellipsoids, k: np.ndarray, height: int, width: int) -> np.ndarray:
    """Z of the nearest surface of one hand, (H, W) float32 metres, 0 = none.

    As `render_range_images`, but each ellipsoid is drawn within its own box only, in compiled code:
    what draws every frame must not take longer than the tracker.

    ellipsoids: (1, E).  k: (3, 3).
    """
    centres, axes = ellipsoids.centres_m[0].numpy(), ellipsoids.axes_m[0].numpy()
    image = np.zeros((height, width), np.float32)
    _draw(np.ascontiguousarray(centres), np.ascontiguousarray(axes), np.array(k, np.float64), image)
    return image


@entry_point
def _draw(centres, axes, k, image):
    """Z of the nearest of E ellipsoids, (E, 3) and (E, 3, 3), into an image of zeros.  k: (3, 3).

    The formulas are those of reference.render_range_images.
    """
    height, width = image.shape
    linear, quadratic, box = np.empty(3), np.empty((3, 3)), np.empty(4, np.int64)
    for e in range(len(centres)):
        if not _project(centres[e], axes[e], k, height, width, linear, quadratic, box):
            continue
        l0, l1, l2 = np.float32(linear[0]), np.float32(linear[1]), np.float32(linear[2])
        xx, xy, xz = quadratic[0, 0], quadratic[0, 1], quadratic[0, 2]
        yy, yz, zz = quadratic[1, 1], quadratic[1, 2], quadratic[2, 2]
        for row in range(box[2], box[3]):
            y = (row - k[1, 2]) / k[1, 1]
            for column in range(box[0], box[1]):
                x = (column - k[0, 2]) / k[0, 0]
                square = (xx * x + 2 * xz) * x + (yy * y + 2 * yz) * y + zz + 2 * xy * x * y
                if square >= 0:
                    inverse = l0 * x + l1 * y + l2 + math.sqrt(square)
                    image[row, column] = max(image[row, column], np.float32(inverse))
    for row in range(height):
        for column in range(width):
            if image[row, column] > 0:
                image[row, column] = 1 / image[row, column]


@compiled
def _project(centre, axes, k, height, width, linear, quadratic, box):
    """Linear (3,) and quadratic (3, 3) parts of an ellipsoid's inverse depth, and its box: left,
    right, top, bottom, a pixel wider than it; False where it is not before the camera.
    """
    whiten, s, square, reach = np.empty((3, 3)), np.zeros(3), 0.0, 0.0
    for j in range(3):
        size = axes[0, j] ** 2 + axes[1, j] ** 2 + axes[2, j] ** 2
        reach += axes[2, j] ** 2
        for i in range(3):
            whiten[j, i] = axes[i, j] / size
            s[j] += whiten[j, i] * centre[i]
        square += s[j] * s[j]
    if not centre[2] - math.sqrt(reach) > NEAREST_M:
        return False
    for i in range(3):
        back = whiten[0, i] * s[0] + whiten[1, i] * s[1] + whiten[2, i] * s[2]
        linear[i] = back / (square - 1)
    for i in range(3):
        for j in range(3):
            both = 0.0
            for row in range(3):
                both += whiten[row, i] * whiten[row, j]
            quadratic[i, j] = linear[i] * linear[j] - both / (square - 1)
    last = reach - centre[2] * centre[2]
    for i in range(2):
        own, mixed = -centre[i] * centre[i], -centre[i] * centre[2]
        for j in range(3):
            own += axes[i, j] * axes[i, j]
            mixed += axes[i, j] * axes[2, j]
        mean = mixed / last
        spread = math.sqrt(max(mean * mean - own / last, 0.0))
        most = float(width if i == 0 else height)
        low = math.ceil(k[i, i] * (mean - spread) + k[i, 2]) - 1.0
        high = math.floor(k[i, i] * (mean + spread) + k[i, 2]) + 2.0
        box[2 * i], box[2 * i + 1] = int(min(max(low, 0.0), most)), int(min(max(high, 0.0), most))
    return True


def model_range_image(
    state: np.ndarray, shape: HandShape, k: np.ndarray, height: int, width: int
) -> np.ndarray:
    """The surface of a hand without its forearm, (H, W) float32 metres, 0 = none.

    state: (27,); where it is NaN there was no estimate, and the image is empty.  k: (3, 3).
    """
    if not np.isfinite(state).all():
        return np.zeros((height, width), np.float32)
    hand, _ = posed_hand(state, shape)
    return range_image(hand, k, height, width)
