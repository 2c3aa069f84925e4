"""What a hand's length says of the camera: too large a focal length makes hands small.

Fitted lengths are within 5 % of the true ones where the fit is as sure as is asked for here, over
simulated people with hands of 147 to 203 mm and real cameras; none of them is doubted, and what is
farthest off has 5 % left.
"""

from __future__ import annotations

import math

import numpy as np

from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, HandShape

_SMALLEST_M, _LARGEST_M = 0.145, 0.210
"""Hands between these are no reason to doubt: of children from about ten years on, and of all but
one man in a hundred (ANSUR II)."""
_SIGMAS = 2.0
"""So sure must a fit be that the hand lies beyond."""
_APPARENT_M = (0.135, 0.215)
"""Likewise of what the networks say of a hand that was lost, whose lengths stay nearer to the
usual."""


def length_doubt(shape: HandShape, k: np.ndarray) -> str:
    """What speaks against the camera matrix k (3, 3), in pixels, where a hand was fitted; "" for
    nothing."""
    fitted = shape.fitted
    if fitted is None:
        return ""
    length, factor = shape.hand_length_m, math.exp(_SIGMAS * fitted.sigma[0])
    if _SMALLEST_M <= length * factor and length / factor <= _LARGEST_M:
        return ""
    return _sentence(f"the fitted hand is {1e3 * length:.0f} mm long", length, k)


def apparent_doubt(length_m: float, k: np.ndarray) -> str:
    """Likewise by the mean length that the networks gave a hand that was lost in most frames."""
    if _APPARENT_M[0] <= length_m <= _APPARENT_M[1]:
        return ""
    return _sentence(f"the hand looks {1e3 * length_m:.0f} mm long", length_m, k)


def _sentence(what: str, length_m: float, k: np.ndarray) -> str:
    small = length_m < DEFAULT_HAND_LENGTH_M
    usual, focal = 1e3 * DEFAULT_HAND_LENGTH_M, float(np.asarray(k)[0, 0])
    whose = "only small children's are" if small else "hardly anybody's is"
    wrong = "large" if small else "small"
    return (
        f"{what}, as {whose}: of anybody else, the focal length is too {wrong}, or the depth is in "
        f"another unit; fx = {focal * length_m / DEFAULT_HAND_LENGTH_M:.4g} instead of {focal:.4g} "
        f"pixels would make it {usual:.0f} mm (camera.file=FILE, or K of the recording)"
    )
