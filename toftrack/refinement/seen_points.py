"""What the refinement sees of a frame: points of the hand and the silhouette around them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.compute.compiling import entry_point
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
    nearest_px: (h, w, 2) for each pixel of a crop the nearest pixel (u, v) of the image that is
        not background. The crop holds all of these and a margin; it is empty where there are none.
    k, size: (3, 3) and (H, W) of the image.  corner: row and column of the crop's first pixel.
    """

    points_m: Tensor
    nearest_px: Tensor
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
    k = observation.k.numpy()
    depth = observation.depth_m.numpy()[part]
    points = smooth_points(depth, hand[part], (top, left), k)
    nearest = np.zeros((0, 0, 2), np.float32)
    if solid[part].size:
        away, kind = (~solid[part]).view(np.uint8), cv2.DIST_LABEL_PIXEL
        labels = cv2.distanceTransformWithLabels(
            away, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=kind
        )[1]
        nearest = nearest_of_labels(labels, solid[part], (top, left))
    return SeenPoints(
        torch.from_numpy(points),
        torch.from_numpy(nearest),
        observation.k,
        (solid.shape[0], solid.shape[1]),
        (top, left),
    )


def smooth_points(
    depth_m: np.ndarray, hand: np.ndarray, corner: tuple[int, int], k: np.ndarray
) -> np.ndarray:
    """(P, 3) float32 points of the hand's pixels that are on no depth edge, row by row.

    depth_m, hand: (h, w) of a crop whose first pixel is at `corner`, row and column.  k: (3, 3).
    """
    points = np.empty((hand.size, 3), np.float32)
    return points[: _add_points(depth_m, hand, corner, k, points)]


@entry_point
def _add_points(depth_m, hand, corner, k, points):
    """See smooth_points; how many of `points` (h w, 3) are written."""
    height, width = hand.shape
    count = 0
    for v in range(height):
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


def nearest_of_labels(labels: np.ndarray, solid: np.ndarray, corner: tuple[int, int]) -> np.ndarray:
    """(h, w, 2) float32: the image's column and row of the nearest solid pixel of a crop.

    labels: (h, w) numbers of these pixels, of OpenCV's distance transform.  solid: (h, w) bool.
    """
    nearest = np.empty((*solid.shape, 2), np.float32)
    _look_up(labels, solid, corner, np.zeros((solid.size + 1, 2), np.float32), nearest)
    return nearest


@entry_point
def _look_up(labels, solid, corner, places, nearest):
    """See nearest_of_labels; places: (h w + 1, 2) of the labels, and `nearest` are written."""
    height, width = solid.shape
    for v in range(height):
        for u in range(width):
            if solid[v, u]:
                places[labels[v, u], 0] = u + corner[1]
                places[labels[v, u], 1] = v + corner[0]
    for v in range(height):
        for u in range(width):
            nearest[v, u, 0] = places[labels[v, u], 0]
            nearest[v, u, 1] = places[labels[v, u], 1]
