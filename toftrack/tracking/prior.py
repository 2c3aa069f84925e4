"""What speaks for and against a hand besides the image of it: its arm, and how it was seen last.

A hand hangs on an arm, and the arm goes on until the image ends. The silhouette of a hand with its
forearm looks much like that of a hand the other way round. But there the arm would have to be where
the fingers end, and the image shows the background; or the fingers would be where the arm leaves
the image.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.checks import check_number
from toftrack.compute.rotations import rotvec_geodesic_distance, rotvec_to_rotmat
from toftrack.render.segmentation import Observation

_ALONG_M = (0.05, 0.07, 0.09)
"""Points of the forearm's axis, from the wrist."""
_BENT = 0.7
"""The wrist bends: the arm may be this far beside the axis, in parts of the way from the wrist."""
_BEHIND_M = 0.06
"""What lies less than this behind the axis may be the arm."""
_EXITS = 64
"""Points at most where the blob leaves the image."""


@dataclass(frozen=True)
class ArmSight:
    """What an image says of arms.

    depth_m: (H, W) Z, 0 where there is no reading, which may be a dark sleeve.
    gap_px: (H, W) distance to the nearest pixel that is not background.
    exits_m: (E, 3) points where the blob leaves the image.
    k: (3, 3).
    """

    depth_m: Tensor
    gap_px: Tensor
    exits_m: Tensor
    k: Tensor


@dataclass(frozen=True)
class LastSeen:
    """The hand as it was last believed.

    particle: (1, 6 + d).  age_s: how long ago.
    """

    particle: Tensor
    age_s: float


@dataclass(frozen=True)
class Prior:
    """A hand hangs on an arm, and it does not turn round all at once; see conf/start/prior.yaml.

    forearm: taken from the log score of a hand whose forearm cannot be.
    memory: added to the log score of a hand that is turned as it was before it was lost ...
    memory_rad: ... with less the farther it has turned since (standard deviation) ...
    memory_s: ... and the longer ago it was (to 1/e).
    """

    forearm: float
    memory: float
    memory_rad: float
    memory_s: float

    def __post_init__(self) -> None:
        for name in ("forearm", "memory"):
            check_number(f"start.{name}", getattr(self, name), 0)
        for name in ("memory_rad", "memory_s"):
            check_number(f"start.{name}", getattr(self, name), 0, above=True)

    def __call__(
        self, observation: Observation, last: LastSeen | None
    ) -> Callable[[Tensor], Tensor]:
        """In a frame: hypotheses (N, 6 + d) to (N,), added to their log scores.

        last: the hand as it was last believed, if it ever was.
        """
        sight = arm_sight(observation)

        def log_prior(particles: Tensor) -> Tensor:
            known = -self.forearm * forearm_conflict(particles, sight)
            if last is not None:
                before = last.particle[:, 3:6].expand(len(particles), -1)
                turned = rotvec_geodesic_distance(particles[:, 3:6], before)
                likeness = torch.exp(-0.5 * (turned / self.memory_rad).square())
                known = known + self.memory * math.exp(-last.age_s / self.memory_s) * likeness
            return known

        return log_prior


def arm_sight(observation: Observation) -> ArmSight:
    """Prepare an image for `forearm_conflict`."""
    depth, k = observation.depth_m, observation.k
    background = ~(observation.hand | observation.occluder) & (depth > 0)
    if observation.other is not None:
        background &= ~observation.other
    gap = cv2.distanceTransform(
        background.cpu().numpy().view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5
    )
    hand = observation.hand.cpu().numpy()
    border = np.zeros_like(hand)
    border[[0, -1], :] = border[:, [0, -1]] = True
    v, u = np.nonzero(hand & border)
    some = slice(None, None, max(1, -(-len(v) // _EXITS)))
    rows, columns = (torch.from_numpy(index[some].copy()).to(depth.device) for index in (v, u))
    z = depth[rows, columns]
    x, y = (columns - k[0, 2]) / k[0, 0] * z, (rows - k[1, 2]) / k[1, 1] * z
    exits = torch.stack((x, y, z), 1)
    return ArmSight(depth, torch.from_numpy(gap).to(depth.device), exits, k)


def forearm_conflict(particles: Tensor, sight: ArmSight) -> Tensor:
    """How much of a hypothesis' forearm cannot be, (N,), 0 to 1.

    It is the share of the forearm where the image shows the background instead; and 1 where a blob
    that leaves the image does so only on the side of the fingers, though the wrist is in view.

    particles: (N, 6 + d), wrist translation and rotation vector first.
    """
    wrist = particles[:, :3]
    axis = rotvec_to_rotmat(particles[:, 3:6])[:, :, 1]  # from the fingers to the arm
    along = particles.new_tensor((0.0, *_ALONG_M))
    x = wrist[:, None] + along[:, None] * axis[:, None]  # (N, 4 points, 3)
    k, z = sight.k, x[..., 2].clamp(min=0.05)
    u = (k[0, 0] * x[..., 0] / z + k[0, 2]).round()
    v = (k[1, 1] * x[..., 1] / z + k[1, 2]).round()
    height, width = sight.depth_m.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    row, column = v.long().clamp(0, height - 1), u.long().clamp(0, width - 1)
    behind = sight.depth_m[row, column] > z + _BEHIND_M
    clear = sight.gap_px[row, column] > _BENT * along * k[0, 0] / z
    through = (inside & behind & clear)[:, 1:].float().mean(1)
    if len(sight.exits_m) == 0:
        return through
    farthest = (axis @ sight.exits_m.mT).amax(1) - (axis * wrist).sum(1)
    turned = inside[:, 0] & (farthest < 0)
    return torch.maximum(through, turned.float())
