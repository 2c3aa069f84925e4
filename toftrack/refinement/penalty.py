"""What speaks against the joints of a hand, whatever the image says of it."""

from __future__ import annotations

from torch import Tensor

from toftrack.hand.overlap import finger_overlap
from toftrack.refinement.gauss_newton import Keypoints

FAR_SIGMAS = 3.0
"""Farther off, a joint is as wrong as it can be."""


def joints_penalty(
    joints_m: Tensor,
    hand_length_m: float,
    overlap_weight: float,
    keypoints: Keypoints | None,
    keypoints_weight: float,
) -> Tensor:
    """(N,) at least 0, of joints (N, 21, 3): fingers in one another, joints away from keypoints.

    keypoints: (21, 3) and (21,); None where there are none.  The weights: in units of log scores.
    """
    penalty = joints_m.new_zeros(len(joints_m))
    if overlap_weight:
        penalty = penalty + overlap_weight * finger_overlap(joints_m, hand_length_m)
    if keypoints is None:
        return penalty
    off = ((joints_m - keypoints.points_m).norm(dim=-1) / keypoints.sigma_m).square()
    return penalty + keypoints_weight * (off / (1 + off / FAR_SIGMAS**2)).mean(1)
