"""What confidence.py reads of an image about a hand's joints, compiled."""

from __future__ import annotations

import numpy as np
from numpy import empty

from toftrack.compute.compiling import compiled, entry_point

_AROUND = 9
"""Readings about a joint."""


def count_out_of_sight(joints_m: np.ndarray, depth_m: np.ndarray, k: np.ndarray) -> np.ndarray:
    """(2,) how many joints are outside of the image, and behind something; see out_of_sight."""
    counts = np.zeros(2, np.int64)
    joints, depth = _readable(joints_m, np.float32), _readable(depth_m, np.float32)
    count_joints(joints, depth, _readable(k, np.float32), counts)
    return counts


def seen_around(
    joints_m: np.ndarray, nearest_m: float, step_m: float, depth_m: np.ndarray, k: np.ndarray
) -> np.ndarray:
    """(N, 3) parts of a joint's surroundings outside and without reading, median depth or NaN.

    joints_m: (N, 3).  step_m: from one of the 3 x 3 readings about a joint to the next.
    nearest_m: depth of a joint that is nearer.
    """
    found, depth = np.empty((len(joints_m), 3)), _readable(depth_m, np.float32)
    joints, k = _readable(joints_m, np.float64), _readable(k, np.float64)
    read_around(joints, nearest_m, step_m, depth, k, found)
    return found


def _readable(array: np.ndarray, dtype: type) -> np.ndarray:
    # numba compiles once more for arrays that must not be written to.
    return np.require(array, dtype, ("C", "W"))


@compiled
def _pixel(place, middle, size):
    """The nearest pixel to a place, -1 outside of the image."""
    at = np.rint(place + middle)
    return np.int64(at) if 0 <= at < size else np.int64(-1)


@entry_point
def count_joints(joints, depth, k, counts):
    """See out_of_sight; counts: (2,), written."""
    height, width = depth.shape
    for joint in range(len(joints)):
        z = max(joints[joint, 2], np.float32(0.05))
        column = _pixel(k[0, 0] * joints[joint, 0] / z, k[0, 2], width)
        row = _pixel(k[1, 1] * joints[joint, 1] / z, k[1, 2], height)
        if column < 0 or row < 0:
            counts[0] += 1
        elif depth[row, column] > 0 and depth[row, column] < z - np.float32(0.04):
            counts[1] += 1


@entry_point
def read_around(joints, nearest_m, step_m, depth, k, found):
    """found: (N, 3), written."""
    height, width = depth.shape
    read = empty(_AROUND, np.float64)
    for joint in range(len(joints)):
        z = max(joints[joint, 2], nearest_m)
        inside = count = 0
        for j in range(-1, 2):
            for i in range(-1, 2):
                x, y = joints[joint, 0] + i * step_m, joints[joint, 1] + j * step_m
                column = _pixel(x * (k[0, 0] / z), k[0, 2], width)
                row = _pixel(y * (k[1, 1] / z), k[1, 2], height)
                if column < 0 or row < 0:
                    continue
                inside += 1
                value = np.float64(depth[row, column])
                if not value > 0:
                    continue
                # In order; the lower middle is the median.
                at = count
                while at > 0 and read[at - 1] > value:
                    read[at] = read[at - 1]
                    at -= 1
                read[at] = value
                count += 1
        found[joint, 0] = (_AROUND - inside) / _AROUND
        found[joint, 1] = (inside - count) / _AROUND
        found[joint, 2] = read[(count - 1) // 2] if count > 0 else np.nan
