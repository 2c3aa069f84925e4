"""Where the first hypotheses come from: the segmented hand, or a pose given by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import roma
import torch
from torch import Tensor

from toftrack.errors import ToftrackError
from toftrack.filter import PIVOT_M
from toftrack.pose_space.base import PoseSpace
from toftrack.segmentation import Observation


@dataclass(frozen=True)
class Start:
    """First hypotheses around the segmented hand.

    pose: wrist translation (3, m) and rotation vector (3, rad), the paper's rough manual
    positioning
        of an open palm; None takes the position from the image.
    search: False: an open palm to the camera with its fingers up (the paper's sequences start so).
        True: any orientation in the image plane, palm or back, any training pose.
    hypotheses: how many are scored at once.
    position_m, tilt_rad, in_plane_rad: standard deviations about the guess; in_plane_rad only where
        search is off.
    """

    pose: tuple[float, ...] | None = None
    search: bool = True
    hypotheses: int = 3000
    position_m: float = 0.02
    tilt_rad: float = 0.4
    in_plane_rad: float = 0.2

    def __post_init__(self) -> None:
        if self.pose is not None and len(self.pose) != 6:
            raise ToftrackError(
                f"start.pose has {len(self.pose)} numbers; give six: translation in metres and"
                " rotation vector in radians"
            )

    def particles(
        self, observation: Observation, space: PoseSpace, n: int, generator: torch.Generator
    ) -> Tensor:
        """(M, 6 + d) hypotheses, M = max(n, hypotheses), on the pose space's device.

        observation: not empty unless a pose is given.
        """
        m = max(n, self.hypotheses)
        device = space.lower.device

        def normal(*size: int) -> Tensor:
            return torch.randn(*size, generator=generator, device=device)

        tilt = normal(m, 3) * self.tilt_rad
        tilt[:, 2] = normal(m) * self.in_plane_rad
        if self.pose is not None:
            pose = torch.tensor(self.pose, dtype=torch.float32, device=device)
            rotation = roma.rotvec_composition((tilt, pose[3:].expand(m, 3)))
            translation = pose[:3] + normal(m, 3) * self.position_m
            return torch.cat((translation, rotation, self._palm(space, m)), 1)

        if self.search:
            tilt[:, 2] = torch.rand(m, generator=generator, device=device) * 2 * math.pi
            latent, facing = self._any_pose(space, m, generator)
            rotation = roma.rotvec_composition(
                (_axis(tilt[:, 2], 2), _axis(tilt[:, 0], 0), _axis(tilt[:, 1] + facing, 1))
            )
        else:
            latent, rotation = self._palm(space, m), tilt
        centre = torch.from_numpy(palm_centre(observation)).to(device)
        pivot = roma.rotvec_to_rotmat(rotation) @ rotation.new_tensor(PIVOT_M)
        translation = centre + normal(m, 3) * self.position_m - pivot
        return torch.cat((translation, rotation, latent), 1)

    @staticmethod
    def _palm(space: PoseSpace, m: int) -> Tensor:
        rows = [label == "palm" for label in space.training_labels]
        return space.training_latents[rows.index(True) if True in rows else 0].expand(m, -1)

    @staticmethod
    def _any_pose(space: PoseSpace, m: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        device = space.lower.device
        count = len(space.training_latents)
        rows = torch.randint(count, (m,), generator=generator, device=device)
        back = torch.rand(m, generator=generator, device=device) < 0.5
        return space.training_latents[rows], back * math.pi


def _axis(angle: Tensor, axis: int) -> Tensor:
    vector = torch.zeros(len(angle), 3, device=angle.device)
    vector[:, axis] = angle
    return vector


def palm_centre(observation: Observation) -> np.ndarray:
    """The middle of the palm, (3,) float32 metres: the centre of the widest disc in the hand's
    silhouette, a palm's half-thickness behind the surface seen there.
    """
    hand = observation.hand.cpu().numpy().astype(np.uint8)
    depth = observation.depth_m.cpu().numpy()
    k = observation.k.cpu().numpy()
    # The image's border is no silhouette edge for an arm that leaves the picture, so no padding.
    distance = cv2.distanceTransform(hand, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    v, u = np.unravel_index(int(distance.argmax()), distance.shape)
    radius = max(1, int(distance[v, u] / 2))
    patch = (slice(max(0, v - radius), v + radius + 1), slice(max(0, u - radius), u + radius + 1))
    z = float(np.median(depth[patch][hand[patch] > 0])) + 0.012
    return np.array([(u - k[0, 2]) / k[0, 0] * z, (v - k[1, 2]) / k[1, 1] * z, z], np.float32)
