"""What a pose space is: a map between few latent coordinates and the 21 joint angles."""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.transfer import table
from toftrack.errors import ToftrackError
from toftrack.hand.skeleton import ANGLE_LIMITS


@dataclass(frozen=True, eq=False)
class PoseSpace:
    """A learned low-dimensional space of hand poses (paper, section 2.3).

    A further kind is a subclass, whose tensors are what its model file holds, with a class method
    `fit(angles, labels, dims, **settings)` that learns one, if it can be (docs/extending.md).

    kind: the name that stands in model files; that of the class where it gives none.
    lower, upper: (d,) bounds: the extremes of the training poses in each coordinate.
    training_latents: (M, d) the training poses, and training_labels their M names.
    """

    kind: ClassVar[str]

    lower: Tensor
    upper: Tensor
    training_latents: Tensor
    training_labels: tuple[str, ...]

    def __init_subclass__(cls) -> None:
        cls.kind = vars(cls).get("kind", cls.__name__)

    @property
    def dims(self) -> int:
        """d, the number of latent coordinates."""
        return self.training_latents.shape[1]

    def decode_freely(self, latent: Tensor) -> Tensor:
        """(N, d) to (N, 21) radians, without regard to the joint limits."""
        raise NotImplementedError

    def encode(self, angles: Tensor) -> Tensor:
        """(N, 21) joint angles, radians, to (N, d) coordinates (not clipped to the bounds)."""
        raise NotImplementedError

    def decode(self, latent: Tensor) -> Tensor:
        """(N, d) to (N, 21) radians, clamped to the joint limits."""
        return clamp_to_joint_limits(self.decode_freely(latent))

    def arrays(self) -> dict[str, Tensor]:
        """The tensors of the model file."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "training_labels"}

    def to(self, device: torch.device | str, dtype: torch.dtype = torch.float32) -> Self:
        """The same space on another device or of another dtype."""
        moved: dict[str, Any] = {k: value.to(device, dtype) for k, value in self.arrays().items()}
        return replace(self, **moved)


def clamp_to_joint_limits(angles: Tensor) -> Tensor:
    """(N, 21) radians, each within hand.skeleton.ANGLE_LIMITS."""
    return angles.clamp(*_limits(angles.device, angles.dtype))


@functools.cache
def _limits(device: torch.device, dtype: torch.dtype) -> tuple[Tensor, ...]:
    """The lower and the upper joint limits, each (21,)."""
    return table(ANGLE_LIMITS, dtype, device).T.contiguous().unbind(0)


def check_dims(dims: int, poses: int, most: int) -> None:
    """ToftrackError where so many poses do not make a space of `dims` dimensions."""
    if not 1 <= dims <= most:
        raise ToftrackError(
            f"pose_space.dims={dims} cannot be learned from {poses} poses; give 1 to {most}"
        )


def signed(columns: np.ndarray) -> np.ndarray:
    """Coordinates (M, d), whose signs are arbitrary, with the largest entry of each positive."""
    return columns * np.sign(columns[np.abs(columns).argmax(0), np.arange(columns.shape[1])])


def tensor32(array: np.ndarray | float) -> Tensor:
    """A float32 tensor with its own memory."""
    return torch.tensor(np.asarray(array), dtype=torch.float32)


def clamped_share(space: PoseSpace, latent: Tensor) -> float:
    """Part of the decoded angles, 0 .. 1, that the joint limits had to move; latent (N, d)."""
    free = space.decode_freely(latent)
    moved = (clamp_to_joint_limits(free) - free).abs() > 1e-3
    return float(moved.float().mean())
