"""Fingers that are in one another, which no image of one finger speaks against."""

from __future__ import annotations

import torch
from torch import Tensor

from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M

_APART_M = 0.013
"""Axes of fingers that touch are farther apart than this, for the mean adult's hand."""
_PAIRS = [(a, b) for a in range(5) for b in range(a + 1, 5)]


def finger_overlap(joints_m: Tensor, hand_length_m: float) -> Tensor:
    """How much the fingers of hands are in one another, (N, 21, 3) to (N,); 0 = not at all.

    Of every two fingers, the points along the outer two bones of each (their ends and middles) are
    compared: 1 for a point that lies on the other finger's axis, less towards `_APART_M`. The sum
    over all pairs of fingers.
    """
    ends = joints_m[:, 1:].unflatten(1, (5, 4))[:, :, 1:]  # (N, 5, 3, 3)
    middles = (ends[:, :, 1:] + ends[:, :, :-1]) / 2
    points = torch.cat((ends, middles), 2)  # (N, 5, 5, 3)
    first, second = (points[:, [pair[i] for pair in _PAIRS]] for i in (0, 1))
    gap = torch.cdist(first, second).amin(3)  # (N, pairs, 5)
    apart = _APART_M * hand_length_m / DEFAULT_HAND_LENGTH_M
    return (1 - gap / apart).clamp(min=0).square().sum((1, 2))
