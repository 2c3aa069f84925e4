"""Training pictures as crops: the same as crops.channels, in one pass."""

from __future__ import annotations

import numpy as np

from toftrack.compute.compiling import announced, entry_point
from toftrack.detector.crops import CROP, CROP_CHANNELS, CROP_M
from toftrack.detector.network import PARTS

_entry = entry_point(__file__)
_PER_PART = CROP // PARTS
_SCALE, _QUARTER = np.float32(2 / CROP_M), np.float32(0.25)


def read_pictures(
    depth: np.ndarray,
    labels: np.ndarray,
    side: np.ndarray,
    distance_m: np.ndarray,
    border: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Crops (N, CROP_CHANNELS, CROP, CROP) that pictures fill, and parts (N, PARTS, PARTS).

    depth, labels: (N, H, W) of side (N,) pixels each.  distance_m: (N,) of the crops' centres.
    border: (N, 2, 3) what is in the image, a x + b y < c for x, y in -0.5 .. 0.5; parts beyond are
    -1, and nothing is read there.
    """
    n = len(depth)
    image = np.zeros((n, CROP_CHANNELS, CROP, CROP), np.float32)
    parts = np.empty((n, PARTS, PARTS), np.int8)
    with announced("detector: compiling the training crops' kernel (once, about 2 s)"):
        _read(depth, labels, side, distance_m, border, image, parts)
    return image, parts


@_entry
def _read(depth, labels, side, distance, border, image, parts):
    index = np.empty(2 * CROP, np.int64)
    for n in range(len(depth)):
        for i in range(2 * CROP):
            index[i] = int((i + 0.5) * side[n] / (2 * CROP))
        edge = border[n]
        for row in range(CROP):
            for column in range(CROP):
                total, near, count, outside = np.float32(0), 0, 0, 0
                image[n, 4:, row, column] = 1
                for line in range(2 * row, 2 * row + 2):
                    y = (line + 0.5) / (2 * CROP) - 0.5
                    for sample in range(2 * column, 2 * column + 2):
                        x = (sample + 0.5) / (2 * CROP) - 0.5
                        if (
                            edge[0, 0] * x + edge[0, 1] * y >= edge[0, 2]
                            or edge[1, 0] * x + edge[1, 1] * y >= edge[1, 2]
                        ):
                            outside += 1
                            continue
                        z = depth[n, index[line], index[sample]]
                        if z > 0:
                            relative = (z - distance[n]) * _SCALE
                            clipped = min(max(relative, np.float32(-1)), np.float32(1))
                            total += clipped
                            each = 4 + 2 * (line - 2 * row) + sample - 2 * column
                            image[n, each, row, column] = clipped
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
                parts[n, row, column] = labels[n, index[line], index[sample]]
                if image[n, 3, line // 2, sample // 2] > 0.5:
                    parts[n, row, column] = -1
