"""The loops over pixels of seen_points.py, compiled."""

from __future__ import annotations

import numpy as np
from numpy import zeros

from toftrack.compute.compiling import entry_point


def smooth_points(
    depth_m: np.ndarray,
    hand: np.ndarray,
    corner: tuple[int, int],
    k: np.ndarray,
    edge_m: float,
    far_m: float,
) -> np.ndarray:
    """See seen_points.smooth_points."""
    points = np.empty((depth_m.size, 3), np.float32)
    count = np.zeros(1, np.int64)
    depth = np.ascontiguousarray(depth_m, np.float32)
    k = np.ascontiguousarray(k, np.float32)
    limits = np.float32(edge_m), np.float32(far_m)
    given = (depth, np.ascontiguousarray(hand), *corner, k, *limits, points, count)
    fill_points(*given)
    return points[: count[0]]


def nearest_of_labels(labels: np.ndarray, solid: np.ndarray, corner: tuple[int, int]) -> np.ndarray:
    """See seen_points.nearest_of_labels."""
    nearest = np.empty((*solid.shape, 2), np.float32)
    solid = np.ascontiguousarray(solid)
    fill_nearest(np.ascontiguousarray(labels), solid, *corner, nearest)
    return nearest


@entry_point
def fill_points(depth, hand, top, left, k, edge, far, points, count):
    """points: (h * w, 3) and count: (1,), written."""
    height, width = depth.shape
    found = 0
    for row in range(height):
        for column in range(width):
            if not hand[row, column]:
                continue
            nearest, farthest = far, np.float32(0.0)
            for i in range(max(row - 1, 0), min(row + 2, height)):
                for j in range(max(column - 1, 0), min(column + 2, width)):
                    z = depth[i, j] if depth[i, j] > 0 else far
                    nearest, farthest = min(nearest, z), max(farthest, z)
            if not farthest - nearest < edge:
                continue
            z = depth[row, column]
            points[found, 0] = (np.float32(column + left) - k[0, 2]) / k[0, 0] * z
            points[found, 1] = (np.float32(row + top) - k[1, 2]) / k[1, 1] * z
            points[found, 2] = z
            found += 1
    count[0] = found


@entry_point
def fill_nearest(labels, solid, top, left, nearest):
    """nearest: (h, w, 2), written."""
    height, width = solid.shape
    places = zeros((height * width + 1, 2), np.float32)
    for row in range(height):
        for column in range(width):
            if solid[row, column]:
                places[labels[row, column], 0] = np.float32(column + left)
                places[labels[row, column], 1] = np.float32(row + top)
    for row in range(height):
        for column in range(width):
            nearest[row, column, 0] = places[labels[row, column], 0]
            nearest[row, column, 1] = places[labels[row, column], 1]
