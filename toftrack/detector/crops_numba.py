"""Reading a crop from an image in compiled code; the same as crops.crop."""

from __future__ import annotations

import math

import numpy as np

from toftrack.compute.compiling import compiled, entry_point
from toftrack.detector.crops import CROP, CROP_M

_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_LEAST_SLOPE = np.float32(0.05)


@entry_point
def crop_at(depth, mirror, k, centre, turn, image):
    """See crops.crop: about a centre (3,), turned by (3, 3), into an image (C, CROP, CROP).

    depth: (H, W) float32, Z in metres.  mirror: it is read as a mirror shows it; k and the centre
    are those of the mirrored.  image: float32, written, see crops.channels, from the pixels nearest
    to its samples.
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
    """Of a line's samples: the flat places of their pixels, -1 for none, and z over Z.

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
