"""What the networks see: a metric crop about a point, and the whole image at one focal length.

Both come from the rectified image as it is, at any resolution, by reading the nearest pixel at the
points of a grid; nothing is interpolated over depth edges.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.compiling import compiled, entry_point, shared_entry_point

CROP_M = 0.30
"""Side of the cube that a crop shows."""
CROP = 64
"""Cells of a crop, each of 2 x 2 readings."""
CROP_CHANNELS = 8
"""Of a crop, see `crop_at`."""
_ENOUGH_F_PX, _ENOUGH_PIXELS = 250.0, 176 * 144
"""Focal length, pixels, and number of pixels that a thinned image keeps at least: at 0.6 m its
pixels are as wide as the readings of a crop are apart (16 recordings of 640 x 480 pixels, f = 503
to 587: usable +0.1 [-0.5, +0.7], mean -0.1 mm [-0.2, +0.1], a fifth less time)."""
WIDE_F_PX = 100.0
"""Focal length of the whole image that the finder sees, pixels."""
WIDE_MULTIPLE = 16
"""Its columns and rows are a multiple of this."""
WIDE_LARGEST_PX = 512
"""Its most columns and rows: a wider view than 137 degrees is seen at a smaller focal length."""
WIDE_RANGE_M = 1.6
"""Farther away, all is the same to the finder."""


def thinned(depth_m: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An image (H, W) with no more pixels than crops can use, and its intrinsics (3, 3): of one
    whose focal length is n times 250 px or more, every n-th row and column, so long as
    _ENOUGH_PIXELS are left.

    All that is done with an image takes longer the larger it is.
    """
    step = min(int(k[0, 0] / _ENOUGH_F_PX), math.isqrt(depth_m.size // _ENOUGH_PIXELS))
    if step <= 1:
        return depth_m, k
    first, k = (step - 1) // 2, k.copy()
    k[:2, 2] -= first
    k[:2] /= step
    return np.ascontiguousarray(depth_m[first::step, first::step]), k


def crop_rotation(centre_m: np.ndarray, up: np.ndarray | None = None) -> np.ndarray:
    """(3, 3) from the crop's frame, whose z axis points at the centre (3,), to the camera's.

    up: (3,) direction whose part across the z axis is up (-y) in the crop; None: the camera's up.
    """
    x, y, z = map(float, centre_m)
    distance = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    x, y, z = x / distance, y / distance, z / distance
    # The shortest one; straight back there is none.
    part = 1 / max(1 + z, 1e-12)
    upright = np.array(
        [[1 - x * x * part, -x * y * part, x], [-x * y * part, 1 - y * y * part, y], [-x, -y, z]]
    )
    if up is None:
        return upright
    across, down, _ = up @ upright
    # By how much a crop is turned about its z axis so that this direction, x and y, is up.
    angle = math.atan2(across, -down) if across or down else 0.0
    c, s = math.cos(angle), math.sin(angle)
    return upright @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_LEAST_SLOPE = np.float32(0.05)
_WIDE_RANGE = float(np.float32(WIDE_RANGE_M))
"""In double precision: a kernel multiplies by the reciprocal, and only so the rounded quotient is
that of single precision."""


@shared_entry_point
def crop_at(depth, mirror, k, centre, turn, image):
    """What is in the cube about a centre (3,), turned by (3, 3), see crop_rotation.

    depth: (H, W) float32 rectified Z in metres, 0 = no reading.  mirror: it is read as a mirror
    shows it; k and the centre are those of the mirrored.
    image: (CROP_CHANNELS, CROP, CROP) float32, written, from the pixels nearest to its samples:
    mean depth about the centre in half cubes, -1 .. 1 (1 where nothing is read); share of readings
    in the cube; share without a reading; share outside of the image, so that a hand that the border
    cuts is not taken for a smaller one; the four readings themselves, as the first channel, row by
    row: a finger is only three cells wide.
    """
    mapping, single = np.empty((3, 3), np.float64), np.empty((3, 3), np.float32)
    slope = np.empty(3, np.float32)
    distance = math.sqrt(centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2)
    focal, middle = 2 * CROP * distance / CROP_M, (2 * CROP - 1) / 2
    largest = 0.0
    for i in range(3):
        for j in range(3):
            mapping[i, j] = k[i, 0] * turn[0, j] + k[i, 1] * turn[1, j] + k[i, 2] * turn[2, j]
        # The crop's pinhole, mapped into the image: u ~ K R K_crop^-1 u_crop.
        mapping[i, 0] /= focal
        mapping[i, 1] /= focal
        mapping[i, 2] -= middle * (mapping[i, 0] + mapping[i, 1])
        for j in range(3):
            largest = max(largest, abs(mapping[i, j]))
    for i in range(3):
        for j in range(3):  # only the ratios count, and a large scale says infinity in float32
            single[i, j] = mapping[i, j] / largest
    slope[0], slope[1] = turn[2, 0] / focal, turn[2, 1] / focal
    slope[2] = turn[2, 2] - middle * (turn[2, 0] + turn[2, 1]) / focal
    scale, away = np.float32(2 / CROP_M), np.float32(distance)
    samples = 2 * CROP
    places, share = np.empty(samples, np.int64), np.empty(samples, np.float32)
    for row in range(CROP):
        for channel in range(len(image)):  # slices take numba long to compile
            for column in range(CROP):
                image[channel, row, column] = _ZERO if channel < 4 else _ONE
        for line in range(2 * row, 2 * row + 2):
            _place(depth.shape, mirror, single, slope, np.float32(line), places, share)
            for sample in range(samples):
                if places[sample] < 0:
                    image[3, row, sample // 2] += np.float32(0.25)
                    continue
                z = depth.flat[places[sample]] * share[sample]
                if z > _ZERO:
                    relative = (z - away) * scale
                    column = sample // 2
                    clipped = min(max(relative, -_ONE), _ONE)
                    image[0, row, column] += clipped
                    image[4 + 2 * (line - 2 * row) + sample % 2, row, column] = clipped
                    image[1, row, column] += np.float32(0.25) * (abs(relative) < _ONE)
                    image[2, row, column] += np.float32(0.25)
        for column in range(CROP):
            share_read = image[2, row, column]
            mean = np.float32(0.25) * image[0, row, column] / max(share_read, np.float32(0.25))
            image[0, row, column] = mean if share_read > _ZERO else _ONE
            image[2, row, column] = _ONE - share_read


@compiled
def _place(shape, flip, mapping, slope, line, places, share):
    """Write for a line's samples the flat index of their pixel, -1 = none, into `places`, and their
    depth z along the crop's axis over their Z into `share`.

    mapping: (3, 3) float32 from the crop's samples to pixels.
    slope: (3,) float32, of a sample: its Z over its z along the crop's axis.
    """
    height, width = np.float32(shape[0]), np.float32(shape[1])
    for sample in range(len(places)):  # vectorised
        a = np.float32(sample)
        w = _ONE / (mapping[2, 0] * a + mapping[2, 1] * line + mapping[2, 2])
        u = np.floor((mapping[0, 0] * a + mapping[0, 1] * line + mapping[0, 2]) * w + _HALF)
        v = np.floor((mapping[1, 0] * a + mapping[1, 1] * line + mapping[1, 2]) * w + _HALF)
        s = slope[0] * a + slope[1] * line + slope[2]
        seen = (w > _ZERO) & (s > _LEAST_SLOPE)
        seen = seen & (u >= _ZERO) & (u < width) & (v >= _ZERO) & (v < height)
        column = width - _ONE - u if flip else u
        place = np.int64(v if seen else _ZERO) * shape[1] + np.int64(column if seen else _ZERO)
        places[sample] = place if seen else -1
        share[sample] = _ONE / s


def wide(depth_m: np.ndarray, k: np.ndarray) -> tuple[Tensor, np.ndarray]:
    """The whole image as the finder sees it, (1, 2, h, w), and its intrinsics (3, 3)."""
    rows, columns, new_k = _wide_grid(depth_m.shape, k.astype(np.float64).tobytes())
    image = np.empty((1, 2, len(rows), len(columns)), np.float32)
    _read_wide(depth_m, rows, columns, image[0])
    return torch.from_numpy(image), new_k


@functools.lru_cache(4)
def _wide_grid(size: tuple[int, int], entries: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rows (h,) and columns (w,) that `wide` reads of an image of a size with the entries of a
    (3, 3) float64 k, and its own intrinsics (3, 3).
    """
    (height, width), k = size, np.frombuffer(entries).reshape(3, 3)
    focal = np.minimum(WIDE_F_PX, k.diagonal()[:2] * WIDE_LARGEST_PX / (width, height))
    scale = focal / k.diagonal()[:2]
    # A multiple, for the network's strides; what is added has no reading.
    w, h = WIDE_MULTIPLE * np.ceil(scale * (width, height) / WIDE_MULTIPLE - 1e-9).astype(int)
    columns = np.rint((np.arange(w) + 0.5) / scale[0] - 0.5).astype(int)
    rows = np.rint((np.arange(h) + 0.5) / scale[1] - 0.5).astype(int)
    new_k = np.diag((*focal, 1.0))
    new_k[:2, 2] = (k[:2, 2] + 0.5) * scale - 0.5
    return rows, columns, new_k


@entry_point
def _read_wide(depth, rows, columns, image):
    """The readings at rows (h,) and columns (w,) into `image` (2, h, w): depth in parts of the
    range, 1 where none; validity. There is none beyond the last row or column.
    """
    height, last = depth.shape[0], depth.shape[1] - 1
    for v in range(len(rows)):
        row = depth[min(rows[v], height - 1)]
        for u in range(len(columns)):
            inside = (rows[v] < height) & (columns[u] <= last)
            z = row[min(columns[u], last)]
            read = inside & (z > _ZERO)
            image[0, v, u] = min(z / _WIDE_RANGE, 1.0) if read else _ONE
            image[1, v, u] = _ONE if read else _ZERO
