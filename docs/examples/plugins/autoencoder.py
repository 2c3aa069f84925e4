"""A pose space of one's own: an autoencoder in torch, trained on the poses that it is given.

toftrack train --config-dir docs/examples/plugins pose_space=autoencoder data=natural
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from toftrack import ToftrackError
from toftrack.pose_space.base import PoseSpace

_NOISE_RAD = 0.05
"""Poses that differ by this are to be one, so that the space does not wave between them."""


@dataclass(frozen=True, eq=False)
class Autoencoder(PoseSpace):
    """Angles to d coordinates and back, each way by a straight line and a bend, W tanh(V x + b).

    mean: (21,) rad.  line: (d, 21) orthonormal rows, along which the poses vary most.
    in_1, in_2: (h, 21), (d, h) and out_1, out_2: (h, d), (21, h) weights.
    in_b, out_b: (h,) biases.
    """

    mean: Tensor
    line: Tensor
    in_1: Tensor
    in_b: Tensor
    in_2: Tensor
    out_1: Tensor
    out_b: Tensor
    out_2: Tensor

    def encode(self, angles: Tensor) -> Tensor:
        """(N, 21) rad to (N, d)."""
        away = angles - self.mean
        return away @ self.line.mT + torch.tanh(away @ self.in_1.mT + self.in_b) @ self.in_2.mT

    def decode_freely(self, latent: Tensor) -> Tensor:
        """(N, d) to (N, 21) rad."""
        bend = torch.tanh(latent @ self.out_1.mT + self.out_b) @ self.out_2.mT
        return self.mean + latent @ self.line + bend

    @classmethod
    @torch.enable_grad()
    def fit(
        cls, angles: Tensor, labels: tuple[str, ...], dims: int, hidden: int = 32, steps: int = 400
    ) -> Autoencoder:
        """Learn from (M, 21) poses, rad; the same poses give the same space.

        hidden: h; more bends more.  steps: of the descent; more fits closer.
        """
        if not 1 <= dims < min(angles.shape):
            raise ToftrackError(f"pose_space.dims={dims} is not possible; give less than 21")
        angles = angles.float()
        mean = angles.mean(0)
        line = torch.linalg.svd(angles - mean, full_matrices=False).Vh[:dims]
        dice = torch.Generator().manual_seed(0)
        sizes = ((hidden, 21), (hidden,), (dims, hidden), (hidden, dims), (hidden,), (21, hidden))
        scales = (0.5, 0.5, 0.02, 0.5, 0.5, 0.02)  # it begins near the straight line
        weights = [
            nn.Parameter(scale * torch.randn(size, generator=dice))
            for scale, size in zip(scales, sizes, strict=True)
        ]

        def made(latents: Tensor, weights: list[Tensor]) -> Autoencoder:
            low, high = latents.amin(0), latents.amax(0)
            return cls(low, high, latents, labels, mean, line, *weights)

        learner = torch.optim.Adam(weights, lr=0.01)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(learner, steps)
        for _ in range(steps):
            space = made(angles[:, :dims], list(weights))
            shaken = angles + _NOISE_RAD * torch.randn(angles.shape, generator=dice)
            off = space.decode_freely(space.encode(shaken)) - angles
            learner.zero_grad()
            torch.autograd.backward(off.square().mean())
            learner.step()
            schedule.step()
        learned = [weight.detach() for weight in weights]
        return made(made(angles[:, :dims], learned).encode(angles), learned)
