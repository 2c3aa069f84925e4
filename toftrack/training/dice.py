"""Random draws of an explicit generator."""

from __future__ import annotations

import roma
import torch
from torch import Tensor


class Dice:
    """Draws of one generator, short to write."""

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def uniform(self, *size: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        """Between low and high."""
        return low + (high - low) * torch.rand(*size, generator=self.generator)

    def normal(self, *size: int) -> Tensor:
        """Mean 0, standard deviation 1."""
        return torch.randn(*size, generator=self.generator)

    def rotations(self, n: int) -> Tensor:
        """(n, 3, 3) any way round, each as likely."""
        return roma.unitquat_to_rotmat(torch.nn.functional.normalize(self.normal(n, 4), dim=1))

    def chance(self, p: float | Tensor, *size: int) -> Tensor:
        """True with probability p, one for all or of a shape like the size."""
        return torch.rand(*size, generator=self.generator) < p

    def rows(self, count: int, n: int) -> Tensor:
        """n whole numbers below count."""
        return torch.randint(count, (n,), generator=self.generator)
