"""What the refinement sees of a frame: points of the hand and the silhouette around them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.render.segmentation import Observation

REACH_M = 0.16
"""Points farther than this from the middle of a hand are none of it."""
_MARGIN_PX = 24
"""Around the silhouette; beyond it, what sticks out is drawn to where it was nearest to."""
_EDGE_M, _FAR_M = 0.03, 10.0
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
    if not hand.any():
        return np.zeros((0, 3), np.float32)
    far = np.where(depth_m > 0, depth_m, np.float32(_FAR_M))
    square = np.ones((3, 3), np.uint8)
    smooth = (cv2.dilate(far, square) - cv2.erode(far, square)) < _EDGE_M
    u, v = _pixels(hand & smooth)
    z = depth_m[v, u]
    x = (u + corner[1] - k[0, 2]) / k[0, 0] * z
    y = (v + corner[0] - k[1, 2]) / k[1, 1] * z
    return np.stack((x, y, z), 1).astype(np.float32)


def nearest_of_labels(labels: np.ndarray, solid: np.ndarray, corner: tuple[int, int]) -> np.ndarray:
    """(h, w, 2) float32: the image's column and row of the nearest solid pixel of a crop.

    labels: (h, w) numbers of these pixels, of OpenCV's distance transform.  solid: (h, w) bool.
    """
    u, v = _pixels(solid)
    lookup = np.zeros((len(u) + 1, 2), np.float32)
    lookup[labels[v, u]] = np.stack((u + corner[1], v + corner[0]), 1)
    return lookup.take(np.asarray(labels), 0)


def _pixels(mask: np.ndarray) -> np.ndarray:
    """Columns and rows of the pixels of a mask, (2, n) int32, row by row."""
    found = cv2.findNonZero(mask.view(np.uint8))
    return np.zeros((2, 0), np.int32) if found is None else found.reshape(-1, 2).T
