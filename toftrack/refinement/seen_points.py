"""What the refinement sees of a frame: points of the hand and the silhouette around them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.compute.compiling import compiled, entry_point
from toftrack.render.segmentation import Observation

REACH_M = 0.16
"""Points farther than this from the middle of a hand are none of it."""
_MARGIN_PX = 24
"""Around the silhouette; beyond it, what sticks out is drawn to where it was nearest to."""
_EDGE_M, _FAR_M = np.float32(0.03), np.float32(10.0)
"""Depths of neighbours that differ by so much are an edge; and the depth where nothing is read."""


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """What the refinement sees of a frame, once a frame and the same for all hypotheses.

    points_m: (P, 3) seen points of the hand and the arm, row by row.
    beside: (h, w) int32, for each pixel of a crop the column, in the crop, of the nearest pixel of
        its row that is not background; -1 = the row has none. The crop holds all of these and a
        margin; it is empty where there are none.
    k, size: (3, 3) and (H, W) of the image.  corner: row and column of the crop's first pixel.
    """

    points_m: Tensor
    beside: Tensor
    k: Tensor
    size: tuple[int, int]
    corner: tuple[int, int] = (0, 0)


@lru_cache(4)  # a frame asks for the same points where sides are compared and where it refines
def seen_points(observation: Observation) -> SeenPoints:
    """The points and the silhouette of an observation.

    Pixels on depth edges are left out: they mix foreground and background.
    """
    # Whatever is not behind the hand may hide it or be it.
    hand = observation.hand.numpy()
    solid = hand | observation.occluder.numpy()
    for mask in (observation.other, observation.thing):
        if mask is not None:
            solid |= mask.numpy()
    left, top, wide, high = cv2.boundingRect(solid.view(np.uint8))
    left, right = max(0, left - _MARGIN_PX), min(solid.shape[1], left + wide + _MARGIN_PX)
    top, bottom = max(0, top - _MARGIN_PX), min(solid.shape[0], top + high + _MARGIN_PX)
    if wide == 0:
        left = top = right = bottom = 0
    part = slice(top, bottom), slice(left, right)
    depth, k = observation.depth_m.numpy()[part], observation.k.numpy()
    points, beside = smooth_points(depth, hand[part], solid[part], (top, left), k)
    size = solid.shape[0], solid.shape[1]
    seen = torch.from_numpy(points), torch.from_numpy(beside)
    return SeenPoints(*seen, observation.k, size, (top, left))


def smooth_points(
    depth_m: np.ndarray, hand: np.ndarray, solid: np.ndarray, corner: tuple[int, int], k: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) float32 points of the hand's pixels that are on no depth edge, row by row; and
    SeenPoints.beside.

    depth_m, hand, solid: (h, w) of a crop whose first pixel is at `corner`, row and column; those
    of the hand, and all that are not background.  k: (3, 3).
    """
    points, beside = np.empty((hand.size, 3), np.float32), np.empty(hand.shape, np.int32)
    return points[: _see(depth_m, hand, solid, corner, k, points, beside)], beside


@entry_point
def _see(depth_m, hand, solid, corner, k, points, beside):
    """See smooth_points; how many of `points` (h w, 3) are written."""
    height, width = hand.shape
    count = 0
    for v in range(height):
        _look_beside(solid[v], beside[v])
        for u in range(width):
            if not hand[v, u]:
                continue
            nearest = farthest = depth_m[v, u] if depth_m[v, u] > 0 else _FAR_M
            for row in range(max(v - 1, 0), min(v + 2, height)):
                for column in range(max(u - 1, 0), min(u + 2, width)):
                    z = depth_m[row, column] if depth_m[row, column] > 0 else _FAR_M
                    nearest, farthest = min(nearest, z), max(farthest, z)
            if farthest - nearest < _EDGE_M:
                z = np.float64(depth_m[v, u])
                points[count, 0] = (u + corner[1] - np.float64(k[0, 2])) / k[0, 0] * z
                points[count, 1] = (v + corner[0] - np.float64(k[1, 2])) / k[1, 1] * z
                points[count, 2] = depth_m[v, u]
                count += 1
    return count


@compiled
def _look_beside(solid, beside):
    """SeenPoints.beside of a row, (w,)."""
    width, last = len(solid), np.int32(-1)
    for u in range(width):
        last = np.int32(u) if solid[u] else last
        beside[u] = last
    last = np.int32(-1)
    for u in range(width - 1, -1, -1):
        last = np.int32(u) if solid[u] else last
        if last >= 0 and (beside[u] < 0 or last - u < u - beside[u]):
            beside[u] = last


@compiled
def nearest_solid(beside, line, column):
    """Row and column of the pixel nearest to one of the crop that is not background.

    beside: see SeenPoints; some row has one.
    """
    height = beside.shape[0]
    square, row, found = np.int64(height + beside.shape[1]) ** 2, line, column
    for away in range(height):
        if away * away >= square:
            break
        for v in (line - away, line + away):
            if v < 0 or v >= height or beside[v, column] < 0:
                continue
            gap = np.int64(beside[v, column]) - column
            if gap * gap + away * away < square:
                square, row, found = gap * gap + away * away, v, np.int64(beside[v, column])
    return row, found
