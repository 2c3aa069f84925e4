"""What a pose space is: a map between few latent coordinates and the 21 joint angles."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from toftrack.hand.skeleton import ANGLE_LIMITS


@runtime_checkable
class PoseSpace(Protocol):
    """A learned low-dimensional space of hand poses (paper, section 2.3).

    A further space is one module with this interface, a line in pose_space/files.py and one file
    in conf/pose_space/.

    kind: the name that stands in model files and configs.
    dims: d, the number of latent coordinates.
    lower, upper: (d,) bounds: the extremes of the training poses in each coordinate.
    training_latents: (M, d) the training poses, and training_labels their M names.
    """

    kind: str
    dims: int
    lower: Tensor
    upper: Tensor
    training_latents: Tensor
    training_labels: tuple[str, ...]

    def decode(self, latent: Tensor) -> Tensor:
        """(N, d) latent coordinates to (N, 21) joint angles within the joint limits, radians."""

    def encode(self, angles: Tensor) -> Tensor:
        """(N, 21) joint angles, radians, to (N, d) coordinates (not clipped to the bounds)."""

    def arrays(self) -> dict[str, Tensor]:
        """Everything that a model file must hold to make this space again."""

    def to(self, device: torch.device | str, dtype: torch.dtype = torch.float32) -> PoseSpace:
        """The same space on another device or of another dtype."""


def clamp_to_joint_limits(angles: Tensor) -> Tensor:
    """(N, 21) radians, each within hand.skeleton.ANGLE_LIMITS."""
    limits = angles.new_tensor(ANGLE_LIMITS)
    return angles.clamp(limits[:, 0], limits[:, 1])
