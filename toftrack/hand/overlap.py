"""Fingers that are in one another, which no image of one finger speaks against."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M
from toftrack.hand.surface import BONE_RADII_MM

PAIRS = [(a, b) for a in range(5) for b in range(a + 1, 5)]
SQUEEZED = 0.6
"""Bent fingers, and the thumb, lie so much closer to others than their radii say: flesh gives."""
STRICT = 4.0
"""How much more it counts when a finger is straight: nothing squeezes it."""
BENT, STRAIGHT = 0.7, 0.9
"""Knuckle to tip, in parts of the finger's length: below the first it is bent, above the other it
is straight."""
RADII_MM = [
    ((proximal + middle) / 2, (middle + last) / 2, last, middle, last)
    for proximal, middle, last in BONE_RADII_MM
]
"""Of the points that are compared: middle joint, last joint, tip, two bones' middles."""


def finger_overlap(joints_m: Tensor, hand_length_m: float) -> Tensor:
    """How much the fingers of hands are in one another, (N, 21, 3) to (N,); 0 = not at all.

    Of every two fingers, points along the outer two bones of each (their ends and middles) are
    compared: 1 for a point that lies on the other finger's axis, less towards the sum of the
    fingers' radii. The sum over all pairs of fingers. Straight fingers do not share any room: two
    hypotheses of the one finger that is seen. Bent ones are squeezed into each other.
    """
    return overlap_of_each(joints_m, hand_length_m).sum(1) / 2


def overlap_of_each(joints_m: Tensor, hand_length_m: float) -> Tensor:
    """The same for each finger with all others, (N, 21, 3) to (N, 5); both on the CPU."""
    # In numpy: on a few hands each of torch's operations takes longer than its arithmetic.
    fingers = joints_m.numpy()[:, 1:].reshape(-1, 5, 4, 3)
    steps = fingers[:, :, 1:] - fingers[:, :, :-1]
    chord = np.linalg.norm(steps.sum(2), axis=-1)
    length = np.maximum(np.linalg.norm(steps, axis=-1).sum(2), 1e-9)
    straight = ((chord / length - BENT) / (STRAIGHT - BENT)).clip(0, 1)
    # The thumb crosses the others, straight or not.
    either = np.maximum(straight[:, _FIRST], straight[:, _SECOND]) * (_FIRST > 0)
    ends = fingers[:, :, 1:]  # (N, 5, 3, 3)
    points = np.concatenate((ends, (ends[:, :, 1:] + ends[:, :, :-1]) / 2), 2)  # (N, 5, 5, 3)
    away = points[:, _FIRST, :, None] - points[:, _SECOND, None]  # (N, pairs, 5, 5, 3)
    gap = np.sqrt(np.einsum("...a,...a->...", away, away))
    share = (SQUEEZED + (1 - SQUEEZED) * either) * (hand_length_m / DEFAULT_HAND_LENGTH_M)
    depth = (1 - gap / (_APART_M * share[:, :, None, None])).clip(0)
    pairs = (1 + (STRICT - 1) * either) * np.square(depth.max(3)).sum(2)
    return torch.from_numpy((pairs @ _OF_FINGER).astype(fingers.dtype))


_FIRST, _SECOND = np.array(PAIRS).T
_RADII_M = np.array(RADII_MM) / 1e3
_APART_M = _RADII_M[_FIRST][:, :, None] + _RADII_M[_SECOND][:, None]
"""(10, 5, 5) how far apart the points of fingers that touch are, of the mean adult."""
_OF_FINGER = (np.eye(5)[_FIRST] + np.eye(5)[_SECOND]).astype(np.float64)
"""(10, 5) whether a finger is one of a pair."""
