"""Fingers that are in one another, which no image of one finger speaks against."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.compiling import entry_point
from toftrack.compute.rigid_numba import distance
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M
from toftrack.hand.surface import BONE_RADII_MM

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
_RADII_M = np.array(RADII_MM) / 1e3


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
    joints = np.ascontiguousarray(joints_m.numpy(), np.float32)
    found = np.zeros((len(joints), 5), np.float32)
    _add_overlaps(joints, hand_length_m / DEFAULT_HAND_LENGTH_M, found)
    return torch.from_numpy(found)


@entry_point
def _add_overlaps(joints, ratio, out):
    """joints: (N, 21, 3) float32.  ratio: hand's length in mean ones.  out: (N, 5), added to."""
    straight, points = np.empty(5), np.empty((5, 5, 3))
    for n in range(len(joints)):
        for finger in range(5):
            knuckle = 1 + 4 * finger
            length = 0.0
            for bone in range(3):
                length += distance(joints[n, knuckle + bone], joints[n, knuckle + bone + 1])
            chord = distance(joints[n, knuckle], joints[n, knuckle + 3])
            part = (chord / max(length, 1e-9) - BENT) / (STRAIGHT - BENT)
            straight[finger] = min(max(part, 0.0), 1.0)
            for end in range(3):
                for i in range(3):
                    points[finger, end, i] = joints[n, knuckle + 1 + end, i]
            for bone in range(2):
                for i in range(3):
                    both = points[finger, bone, i] + points[finger, bone + 1, i]
                    points[finger, 3 + bone, i] = both / 2
        for first in range(5):
            for second in range(first + 1, 5):
                # The thumb crosses the others, straight or not.
                either = max(straight[first], straight[second]) if first > 0 else 0.0
                share = (SQUEEZED + (1 - SQUEEZED) * either) * ratio
                found = 0.0
                for a in range(5):
                    depth = 0.0
                    for b in range(5):
                        apart = (_RADII_M[first, a] + _RADII_M[second, b]) * share
                        gap = distance(points[first, a], points[second, b])
                        depth = max(depth, 1 - gap / apart)
                    found += depth * depth
                found *= 1 + (STRICT - 1) * either
                out[n, first] += found
                out[n, second] += found
