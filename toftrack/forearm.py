"""A hand hangs on an arm: where the image shows what lies behind it, there is none.

The silhouette of fingers with a piece of forearm looks much like a hand the other way round. But
there the arm would have to be where the fingers end, and the image shows the background.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import roma
import torch
from torch import Tensor

from toftrack.segmentation import Observation

_ALONG_M = (0.05, 0.07, 0.09)
"""Points of the forearm's axis, from the wrist."""
_BENT = 0.7
"""The wrist bends: the arm may be this far beside the axis, in parts of the way from the wrist."""
_BEHIND_M = 0.06
"""What lies less than this behind the axis may be the arm."""


@dataclass(frozen=True)
class ArmSight:
    """What an image says of arms.

    depth_m: (H, W) Z, 0 where there is no reading, which may be a dark sleeve.
    gap_px: (H, W) distance to the nearest pixel that is not background.
    k: (3, 3).
    """

    depth_m: Tensor
    gap_px: Tensor
    k: Tensor


def arm_sight(observation: Observation) -> ArmSight:
    """Prepare an image for `seen_through`."""
    depth = observation.depth_m
    background = ~(observation.hand | observation.occluder) & (depth > 0)
    gap = cv2.distanceTransform(
        background.cpu().numpy().view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5
    )
    return ArmSight(depth, torch.from_numpy(gap).to(depth.device), observation.k)


def seen_through(particles: Tensor, sight: ArmSight) -> Tensor:
    """The share of the forearm where the image shows the background instead, (N,), 0 to 1.

    particles: (N, 6 + d), wrist translation and rotation vector first.
    """
    axis = roma.rotvec_to_rotmat(particles[:, 3:6])[:, :, 1]  # from the fingers to the arm
    along = particles.new_tensor(_ALONG_M)
    x = particles[:, None, :3] + along[:, None] * axis[:, None]  # (N, 3 points, 3)
    k, z = sight.k, x[..., 2].clamp(min=0.05)
    u = (k[0, 0] * x[..., 0] / z + k[0, 2]).round()
    v = (k[1, 1] * x[..., 1] / z + k[1, 2]).round()
    height, width = sight.depth_m.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    row, column = v.long().clamp(0, height - 1), u.long().clamp(0, width - 1)
    behind = sight.depth_m[row, column] > z + _BEHIND_M
    clear = sight.gap_px[row, column] > _BENT * along * k[0, 0] / z
    return (inside & behind & clear).float().mean(1)
