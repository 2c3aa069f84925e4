"""The hand of an estimate in other programs' conventions, beside the tracker's own."""

from __future__ import annotations

import functools

import numpy as np

from toftrack.frames.estimate import Estimate
from toftrack.hand.openxr import OpenXRHand, openxr_hand, openxr_rig
from toftrack.hand.shape import HandShape

_DECIMALS = 6
"""Micrometres: so many are less than anybody sees, and a line is half as long as with all."""


def in_all_conventions(
    estimate: Estimate, shape: HandShape, k: np.ndarray, size_px: tuple[int, int]
) -> Estimate:
    """The estimate with landmarks and the joints of OpenXR, which follow from its other fields.

    shape: the hand of the estimate.  k: (3, 3) intrinsics, pixels.  size_px: width, height.
    """
    joints, state = estimate.joints_m, estimate.state

    @functools.cache
    def hand() -> OpenXRHand:
        return openxr_hand(joints, state, openxr_rig(shape))

    return with_landmarks(estimate, k, size_px).updated(
        openxr_position_m=lambda: np.round(hand().position_m, _DECIMALS),
        openxr_orientation=lambda: np.round(hand().orientation, _DECIMALS),
        openxr_radius_m=lambda: np.round(hand().radius_m, _DECIMALS),
    )


def with_landmarks(estimate: Estimate, k: np.ndarray, size_px: tuple[int, int]) -> Estimate:
    """The estimate with its landmarks in an image; k and size_px as of in_all_conventions."""
    joints, k = estimate.joints_m, k.copy()
    return estimate.updated(
        landmarks=lambda: np.round(image_landmarks(joints, k, size_px), _DECIMALS)
    )


def image_landmarks(joints_m: np.ndarray, k: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Joints as MediaPipe's normalised landmarks, (..., 21, 3) metres to (..., 21, 3) without unit.

    x, y: parts of the image's width and height, 0 at its left and upper edge, 1 at the others; of
    the undistorted image, and outside of 0..1 where a joint is outside of it.
    z: depth beyond the wrist's, negative where nearer to the camera, in parts of the image's width
    as a length at the wrist's distance is.
    NaN where a joint has no image.

    k: (3, 3) intrinsics in pixels, whose centres lie at whole numbers.  size_px: width, height.
    """
    joints = np.asarray(joints_m, np.float64)
    width, height = size_px
    depth = np.where(joints[..., 2] > 0, joints[..., 2], np.nan)
    u = joints[..., 0] / depth * k[0, 0] + k[0, 2]
    v = joints[..., 1] / depth * k[1, 1] + k[1, 2]
    wrist = depth[..., :1]
    beyond = (depth - wrist) / wrist * (k[0, 0] / width)
    return np.stack(((u + 0.5) / width, (v + 0.5) / height, beyond), -1)
