"""The same as penalty.py, compiled: for the few hands that are compared in every frame."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.compiling import called, empty, entry_point, zeros
from toftrack.hand import overlap, overlap_numba
from toftrack.hand.overlap_numba import add_overlaps
from toftrack.refinement import penalty
from toftrack.refinement.gauss_newton import Keypoints
from toftrack.refinement.penalty import FAR_SIGMAS

_cached = entry_point(__file__, *(m.__file__ for m in (overlap, overlap_numba, penalty)))


def joints_penalty(
    joints_m: Tensor,
    hand_length_m: float,
    overlap_weight: float,
    keypoints: Keypoints | None,
    keypoints_weight: float,
) -> Tensor:
    """See penalty.joints_penalty; on the CPU, in float32."""
    out = torch.empty(len(joints_m))
    called(
        penalise,
        "tracker: compiling what compares joints (once, about 1 s)",
        joints_m.to("cpu", torch.float32).contiguous().numpy(),
        hand_length_m,
        float(overlap_weight),
        _NONE if keypoints is None else keypoints.points_m.float().contiguous().numpy(),
        _NO_SIGMA if keypoints is None else keypoints.sigma_m.float().contiguous().numpy(),
        float(keypoints_weight),
        out.numpy(),
    )
    return out


_NONE, _NO_SIGMA = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)


@_cached
def penalise(joints, hand_length_m, overlap_weight, points, sigma, keypoints_weight, out):
    """joints: (N, 21, 3), points: (21, 3) and sigma: (21,), or both empty, out: (N,); float32."""
    hand = empty((21, 3), np.float64)
    for n in range(len(joints)):
        of_finger, away = zeros(5, np.float64), 0.0
        for j in range(21):
            for i in range(3):
                hand[j, i] = joints[n, j, i]
        if overlap_weight > 0:
            add_overlaps(hand, hand_length_m, of_finger)
        for j in range(len(points)):
            off = 0.0
            for i in range(3):
                gap = hand[j, i] - points[j, i]
                off += gap * gap
            off /= np.float64(sigma[j]) * sigma[j]
            # Of a sigma that is infinite nothing is known.
            away += off / (1 + off / FAR_SIGMAS**2) / 21
        # Every finger's overlap with all others holds each pair twice.
        overlap_m = 0.0
        for finger in range(5):
            overlap_m += of_finger[finger]
        out[n] = 0.5 * overlap_weight * overlap_m + keypoints_weight * away
