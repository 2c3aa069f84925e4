"""Fingers that are in one another, which no image of one finger speaks against."""

from __future__ import annotations

import functools

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
    """The same for each finger with all others, (N, 21, 3) to (N, 5)."""
    first, second, apart, crossing = _tables(joints_m.device, joints_m.dtype)
    fingers = joints_m[:, 1:].unflatten(1, (5, 4))
    steps = fingers[:, :, 1:] - fingers[:, :, :-1]
    chord = steps.sum(2).norm(dim=-1)
    straight = (chord / steps.norm(dim=-1).sum(2) - BENT) / (STRAIGHT - BENT)
    straight = straight.clamp(0, 1)
    # The thumb crosses the others, straight or not.
    either = torch.maximum(straight[:, first], straight[:, second]) * crossing
    ends = fingers[:, :, 1:]  # (N, 5, 3, 3)
    points = torch.cat((ends, (ends[:, :, 1:] + ends[:, :, :-1]) / 2), 2)  # (N, 5, 5, 3)
    gap = torch.cdist(points[:, first], points[:, second])  # (N, pairs, 5, 5)
    share = (SQUEEZED + (1 - SQUEEZED) * either) * (hand_length_m / DEFAULT_HAND_LENGTH_M)
    depth = (1 - gap / (apart * share[:, :, None, None])).clamp(min=0)
    pairs = (1 + (STRICT - 1) * either) * depth.amax(3).square().sum(2)
    of_finger = pairs.new_zeros(len(pairs), 5)
    return of_finger.index_add_(1, first, pairs).index_add_(1, second, pairs)


@functools.cache
def _tables(device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of the pairs: their fingers (10,), (10,); how far apart the points of fingers that touch are
    (10, 5, 5), metres of the mean adult; and whether none of them is the thumb (10,), 1 or 0.
    """
    first, second = torch.tensor(PAIRS, device=device).unbind(1)
    radii = torch.tensor(RADII_MM, device=device, dtype=dtype) / 1e3
    apart = radii[first][:, :, None] + radii[second][:, None]
    return first, second, apart, (first > 0).to(dtype)
