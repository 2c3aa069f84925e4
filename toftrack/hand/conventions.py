"""The hand of an estimate in other programs' conventions, beside the tracker's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from toftrack.estimate import Estimate
from toftrack.hand.landmarks import image_landmarks
from toftrack.hand.openxr import openxr_hand, openxr_rig
from toftrack.hand.openxr_numba import openxr_hand_compiled
from toftrack.hand.shape import HandShape

_DECIMALS = 6
"""Micrometres: so many are less than anybody sees, and a line is half as long as with all."""


def in_all_conventions(
    estimate: Estimate, shape: HandShape, k: np.ndarray, size_px: tuple[int, int]
) -> Estimate:
    """The estimate with landmarks and the joints of OpenXR, which follow from its other fields.

    shape: the hand of the estimate.  k: (3, 3) intrinsics, pixels.  size_px: width, height.
    """
    known = np.isfinite(estimate.joints_m).all() and np.isfinite(estimate.state).all()
    place = openxr_hand_compiled if known else openxr_hand
    hand = place(estimate.joints_m, estimate.state, openxr_rig(shape))
    return replace(
        estimate,
        landmarks=np.round(image_landmarks(estimate.joints_m, k, size_px), _DECIMALS),
        openxr_position_m=np.round(hand.position_m, _DECIMALS),
        openxr_orientation=np.round(hand.orientation, _DECIMALS),
        openxr_radius_m=np.round(hand.radius_m, _DECIMALS),
    )
