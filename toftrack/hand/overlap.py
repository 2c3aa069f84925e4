"""Fingers that are in one another, which no image of one finger speaks against."""

from __future__ import annotations

import torch
from torch import Tensor

from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M
from toftrack.hand.surface import BONE_RADII_MM

_PAIRS = [(a, b) for a in range(5) for b in range(a + 1, 5)]
_SQUEEZED = 0.6
"""Bent fingers, and the thumb, lie so much closer to others than their radii say: flesh gives."""
_STRICT = 4.0
"""How much more it counts when a finger is straight: nothing squeezes it."""
_BENT, _STRAIGHT = 0.7, 0.9
"""Knuckle to tip, in parts of the finger's length: below the first it is bent, above the other it
is straight."""


def finger_overlap(joints_m: Tensor, hand_length_m: float) -> Tensor:
    """How much the fingers of hands are in one another, (N, 21, 3) to (N,); 0 = not at all.

    Of every two fingers, points along the outer two bones of each (their ends and middles) are
    compared: 1 for a point that lies on the other finger's axis, less towards the sum of the
    fingers' radii. The sum over all pairs of fingers. Straight fingers do not share any room: two
    hypotheses of the one finger that is seen. Bent ones are squeezed into each other.
    """
    return pairs_overlap(joints_m, hand_length_m).sum(1)


def overlap_of_each(joints_m: Tensor, hand_length_m: float) -> Tensor:
    """The same for each finger with all others, (N, 21, 3) to (N, 5)."""
    pairs = pairs_overlap(joints_m, hand_length_m)
    of_finger = pairs.new_zeros(len(pairs), 5)
    for column in (0, 1):
        of_finger.index_add_(
            1, torch.tensor([p[column] for p in _PAIRS], device=pairs.device), pairs
        )
    return of_finger


def pairs_overlap(joints_m: Tensor, hand_length_m: float) -> Tensor:
    """The same for each of the ten pairs, (N, 21, 3) to (N, 10)."""
    fingers = joints_m[:, 1:].unflatten(1, (5, 4))
    bones = (fingers[:, :, 1:] - fingers[:, :, :-1]).norm(dim=-1).sum(2)
    chord = (fingers[:, :, 3] - fingers[:, :, 0]).norm(dim=-1)
    straight = ((chord / bones - _BENT) / (_STRAIGHT - _BENT)).clamp(0, 1)
    straight = torch.cat((torch.zeros_like(straight[:, :1]), straight[:, 1:]), 1)  # no thumb
    ends = fingers[:, :, 1:]  # (N, 5, 3, 3)
    points = torch.cat((ends, (ends[:, :, 1:] + ends[:, :, :-1]) / 2), 2)  # (N, 5, 5, 3)
    first, second = ([pair[i] for pair in _PAIRS] for i in (0, 1))
    gap = torch.cdist(points[:, first], points[:, second])  # (N, pairs, 5, 5)
    radii = _radii_m(joints_m) * (hand_length_m / DEFAULT_HAND_LENGTH_M)
    apart = radii[first][:, :, None] + radii[second][:, None]
    either = torch.maximum(straight[:, first], straight[:, second])
    # The thumb crosses the others, straight or not.
    either = either * either.new_tensor([float(a > 0) for a, _ in _PAIRS])
    share = _SQUEEZED + (1 - _SQUEEZED) * either
    depth = (1 - gap / (apart * share[:, :, None, None])).clamp(min=0)
    weight = 1 + (_STRICT - 1) * either
    return weight * depth.amax(3).square().sum(2)


def _radii_m(like: Tensor) -> Tensor:
    """(5, 5) of the points that are compared: middle joint, last joint, tip, two bones' middles."""
    first, second, last = (like.new_tensor(BONE_RADII_MM) / 1e3).unbind(1)
    return torch.stack(((first + second) / 2, (second + last) / 2, last, second, last), 1)
