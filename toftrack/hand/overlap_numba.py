"""Fingers that are in one another, compiled, for a few hands; see overlap.py."""

from __future__ import annotations

import math

import numpy as np

from toftrack.compute.compiling import compiled
from toftrack.hand.overlap import BENT, PAIRS, RADII_MM, SQUEEZED, STRAIGHT, STRICT
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M

_RADII_M = np.array(RADII_MM) / 1e3
_FIRST, _SECOND = np.array(PAIRS).T.copy()


@compiled
def add_overlaps(joints, hand_length_m, of_finger):
    """Of one hand, joints (21, 3): add each finger's overlap with all others to of_finger (5,)."""
    straight, points = np.empty(5, np.float64), np.empty((5, 5, 3), np.float64)
    for finger in range(5):
        first = 1 + 4 * finger
        whole = _distance(joints[first], joints[first + 3])
        along = 0.0
        for bone in range(3):
            along += _distance(joints[first + bone], joints[first + bone + 1])
        share = (whole / along - BENT) / (STRAIGHT - BENT) if along > 0 else 0.0
        straight[finger] = min(max(share, 0.0), 1.0)
        for i in range(3):
            for j in range(3):
                points[finger, j, i] = joints[first + 1 + j, i]
            for j in range(2):
                points[finger, 3 + j, i] = 0.5 * (
                    joints[first + 1 + j, i] + joints[first + 2 + j, i]
                )
    ratio = hand_length_m / DEFAULT_HAND_LENGTH_M
    for pair in range(len(_FIRST)):
        a, b = _FIRST[pair], _SECOND[pair]
        # The thumb crosses the others, straight or not.
        either = max(straight[a], straight[b]) if a > 0 else 0.0
        share = (SQUEEZED + (1 - SQUEEZED) * either) * ratio
        total = 0.0
        for i in range(5):
            deepest = 0.0
            for j in range(5):
                reach = share * (_RADII_M[a, i] + _RADII_M[b, j])
                p, q = points[a, i], points[b, j]
                x, y, z = p[0] - q[0], p[1] - q[1], p[2] - q[2]
                square = x * x + y * y + z * z
                if square < reach * reach:
                    deepest = max(deepest, 1 - math.sqrt(square) / reach)
            total += deepest * deepest
        total *= 1 + (STRICT - 1) * either
        of_finger[a] += total
        of_finger[b] += total


@compiled
def _distance(p, q):
    x, y, z = p[0] - q[0], p[1] - q[1], p[2] - q[2]
    return math.sqrt(x * x + y * y + z * z)
