"""Training pictures as crops: the same as crops.channels, in one pass."""

from __future__ import annotations

import math

import numpy as np

from toftrack.compute.compiling import entry_point
from toftrack.detector.crops import CROP, CROP_CHANNELS, CROP_M
from toftrack.detector.network import PARTS

_PER_PART = CROP // PARTS
_SCALE, _QUARTER = np.float32(2 / CROP_M), np.float32(0.25)


def read_pictures(
    depth: np.ndarray,
    labels: np.ndarray,
    side: np.ndarray,
    distance_m: np.ndarray,
    turn: np.ndarray,
    border: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Crops (N, CROP_CHANNELS, CROP, CROP) of pictures, and parts (N, PARTS, PARTS).

    depth, labels: (N, H, W) of side (N, 2) pixels: of the picture and, in its middle, of the crop.
    distance_m: (N,) of the crops' centres.  turn: (N,) by how much crops are turned about their
    centres, radians, see crops.upright_angle.
    border: (N, 2, 3) what is in the image, a x + b y < c for x, y in -0.5 .. 0.5 across the crop as
    it were without its turn; parts beyond are -1, and nothing is read there.
    """
    n = len(depth)
    image = np.zeros((n, CROP_CHANNELS, CROP, CROP), np.float32)
    parts = np.empty((n, PARTS, PARTS), np.int8)
    _read(depth, labels, side, distance_m, turn, border, image, parts)
    return image, parts


@entry_point
def _read(depth, labels, side, distance, turn, border, image, parts):
    shown = np.empty((2 * CROP, 2 * CROP), np.int8)
    for n in range(len(depth)):
        edge, each, cosine, sine = border[n], side[n, 1], math.cos(turn[n]), math.sin(turn[n])
        middle = 0.5 * side[n, 0]
        for row in range(CROP):
            for column in range(CROP):
                total, near, count, outside = np.float32(0), 0, 0, 0
                image[n, 4:, row, column] = 1
                for line in range(2 * row, 2 * row + 2):
                    down = (line + 0.5) / (2 * CROP) - 0.5
                    for sample in range(2 * column, 2 * column + 2):
                        across = (sample + 0.5) / (2 * CROP) - 0.5
                        x = cosine * across - sine * down
                        y = sine * across + cosine * down
                        if (
                            edge[0, 0] * x + edge[0, 1] * y >= edge[0, 2]
                            or edge[1, 0] * x + edge[1, 1] * y >= edge[1, 2]
                        ):
                            outside += 1
                            shown[line, sample] = -1
                            continue
                        v = min(max(int(middle + y * each), 0), side[n, 0] - 1)
                        u = min(max(int(middle + x * each), 0), side[n, 0] - 1)
                        shown[line, sample] = labels[n, v, u]
                        z = depth[n, v, u]
                        if z > 0:
                            relative = (z - distance[n]) * _SCALE
                            clipped = min(max(relative, np.float32(-1)), np.float32(1))
                            total += clipped
                            reading = 4 + 2 * (line - 2 * row) + sample - 2 * column
                            image[n, reading, row, column] = clipped
                            near += abs(relative) < 1
                            count += 1
                image[n, 0, row, column] = total / count if count > 0 else 1
                image[n, 1, row, column] = near * _QUARTER
                image[n, 2, row, column] = 1 - count * _QUARTER
                image[n, 3, row, column] = outside * _QUARTER
        for row in range(PARTS):
            for column in range(PARTS):
                # At the middle of the part, as far as there is a sample.
                line = 2 * _PER_PART * row + _PER_PART
                sample = 2 * _PER_PART * column + _PER_PART
                parts[n, row, column] = shown[line, sample]
                if image[n, 3, line // 2, sample // 2] > 0.5:
                    parts[n, row, column] = -1
