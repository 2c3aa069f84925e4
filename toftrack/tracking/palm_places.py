"""Where in a blob the palm of a hand may be, and where its arm leaves the image."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch

from toftrack.render.segmentation import Observation
from toftrack.tracking.forearm import border_pixels

_WIDEST_PALM_M = 0.06
"""Half the breadth of the broadest hand's palm with the ball of the thumb."""
_DEPTH_M = 0.12
"""How far behind the nearest surface a palm typically lies at most."""
_DEPTH_EDGE_M = 0.04
"""Between neighbouring pixels of one surface there is less than this."""


def _points(observation: Observation, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Points of the blob at pixels, a palm's half-thickness behind the surface, (n, 3) metres.

    Outside of the image the surface is as deep as at the nearest pixel inside.
    """
    hand, depth = observation.hand.cpu().numpy(), observation.depth_m.cpu().numpy()
    k = observation.k.cpu().numpy()
    # Noise and flying pixels: the median of a neighbourhood, wherever it is mostly hand.
    smooth = cv2.medianBlur(np.where(hand, depth, 0).astype(np.float32), 5)
    row, column = v.clip(0, hand.shape[0] - 1), u.clip(0, hand.shape[1] - 1)
    z = np.where(smooth[row, column] > 0, smooth[row, column], depth[row, column]) + 0.012
    x, y = (u - k[0, 2]) / k[0, 0] * z, (v - k[1, 2]) / k[1, 1] * z
    return np.stack((x, y, z), 1).astype(np.float32)


def palm_centres(observation: Observation, n: int, generator: torch.Generator) -> np.ndarray:
    """Where the middle of the palm may be, (n, 3) float32 metres.

    They are centres of widest discs: inscribed in the silhouette cut along its depth edges, so that
    a hand in front of the body stands by itself, and no wider than a palm, so that they do not lie
    on the body. The wider and the nearer to the camera a disc is, the oftener it is drawn.

    Up to a third lie where they would if the silhouette went on beyond the image: a hand that
    enters sideways shows fingers and forearm before its palm.
    """
    hand = observation.hand.cpu().numpy()
    depth = observation.depth_m.cpu().numpy()
    kernel = np.ones((3, 3), np.uint8)
    far = np.where(hand, depth, depth.max()).astype(np.float32)
    smooth = hand & (cv2.dilate(far, kernel) - cv2.erode(far, kernel) < _DEPTH_EDGE_M)
    inside = smooth if smooth.any() else hand
    focal = float(observation.k[0, 0])
    # A palm's radius in pixels, and one for the border of zeros that ends the silhouette.
    margin = 1 + math.ceil(_WIDEST_PALM_M * focal / max(observation.nearest_m, 0.1))
    depths = np.pad(depth, margin, mode="edge")
    nearness = np.exp(-(depths - observation.nearest_m) / _DEPTH_M)

    def disc_weights(silhouette: np.ndarray) -> np.ndarray:
        distance = cv2.distanceTransform(silhouette, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        peaks = distance >= cv2.dilate(distance, np.ones((5, 5), np.uint8)) - 0.5
        radius_m = distance * depths / focal
        usable = (silhouette > 0) & peaks & (radius_m < _WIDEST_PALM_M)
        return np.where(usable, radius_m**3 * nearness, 0.0)

    # The border of the image counts as the silhouette's edge, or an arm that leaves the picture
    # would be widest there.
    weights = disc_weights(np.pad(inside.astype(np.uint8), margin))
    if not weights.any():
        weights = np.pad(inside.astype(np.float64), margin)
    if n > 1:
        beyond = disc_weights(_ended(np.pad(inside.astype(np.uint8), margin, mode="edge")))
        beyond = np.where(weights > 0, 0.0, beyond)
        weights = weights + beyond * min(1.0, 0.5 * weights.sum() / max(beyond.sum(), 1e-12))
    spots = torch.multinomial(
        torch.from_numpy(weights.ravel() / weights.max()).double().to(generator.device),
        n,
        replacement=True,
        generator=generator,
    )
    if n == 1:
        spots[0] = int(weights.argmax())
    v, u = np.divmod(spots.cpu().numpy(), weights.shape[1])
    return _points(observation, v - margin, u - margin)


def _ended(silhouette: np.ndarray) -> np.ndarray:
    """The same with an outermost row and column of zeros, in place."""
    silhouette[[0, -1], :] = silhouette[:, [0, -1]] = 0
    return silhouette


def arm_exits(observation: Observation, n: int, generator: torch.Generator) -> np.ndarray | None:
    """Points where the blob leaves the image, (n, 3) float32 metres; None where it does not."""
    v, u = border_pixels(observation)
    if len(v) < 3:
        return None
    rows = torch.randint(len(v), (n,), generator=generator, device=generator.device).cpu().numpy()
    return _points(observation, v[rows], u[rows])
