"""An optimiser that steps along orthogonal matrices (Jordan, "Muon", 2024).

The moving average of a weight matrix's gradients is replaced by the nearest matrix whose singular
values all are near 1, found by five Newton-Schulz iterations, so that rare directions are learned
as fast as common ones. Steps have the size of Adam's (Liu et al., "Muon is scalable for LLM
training", 2025). Biases, norms, the first and the last layers are left to AdamW. With it a training
of 176 000 images is where one with AdamW alone would be after about 1.8 times as many:
docs/lab/detector.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cache
from typing import Any

import torch
from llvmlite.binding import get_host_cpu_features
from torch import Tensor, nn

_ITERATIONS = 5
_QUINTIC = (3.4445, -4.7750, 2.0315)
"""Of the polynomial that brings singular values in 0 .. 1 to about 1, by Jordan."""
_ADAM_SIZE = 0.2
"""Root mean square of a step of Adam, which that of a matrix is brought to."""
_MOMENTUM = 0.95
_BETAS, _EPS = (0.9, 0.999), 1e-8


class Muon(torch.optim.Optimizer):
    """Muon for inner matrices, AdamW for all else, with one learning rate and weight decay."""

    def __init__(
        self, network: nn.Module, ends: Iterable[Tensor], rate: float | Tensor, decay: float
    ):
        """ends: weights that make the network's outputs or see its inputs, left to AdamW.

        rate: may be a () tensor on the network's device, and is read in each step.
        """
        others = {id(weight) for weight in ends}
        inner = [p for p in network.parameters() if p.ndim >= 2 and id(p) not in others]
        chosen = {id(p) for p in inner}
        rest = [p for p in network.parameters() if id(p) not in chosen]
        groups = [{"params": inner, "inner": True}, {"params": rest, "inner": False}]
        super().__init__(groups, {"lr": rate, "weight_decay": decay})

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """One step along the gradients; nothing is read back from a GPU, which replays a step as a
        graph. closure: torch's optimisers have one, and this one none.
        """
        for group in self.param_groups:
            weights = [weight for weight in group["params"] if weight.grad is not None]
            if weights and not group["inner"]:
                count = self.state[weights[0]].setdefault("count", weights[0].new_zeros(()))
                count.add_(1)
            for weight in weights:
                if group["inner"]:
                    along = self._inner(weight, weight.grad)
                else:
                    along = self._adam(weight, weight.grad, count)
                weight.mul_(1 - group["lr"] * group["weight_decay"])
                weight.sub_(group["lr"] * along)

    def _inner(self, weight: Tensor, gradient: Tensor) -> Tensor:
        average = self._kept(weight, "exp_avg").lerp_(gradient, 1 - _MOMENTUM)
        matrix = orthogonal(gradient.lerp(average, _MOMENTUM).flatten(1))
        return matrix.view_as(gradient) * (_ADAM_SIZE * math.sqrt(max(matrix.shape)))

    def _adam(self, weight: Tensor, gradient: Tensor, count: Tensor) -> Tensor:
        mean = self._kept(weight, "exp_avg").lerp_(gradient, 1 - _BETAS[0])
        square = self._kept(weight, "exp_avg_sq").mul_(_BETAS[1])
        square.addcmul_(gradient, gradient, value=1 - _BETAS[1])
        size = (square / (1 - torch.pow(_BETAS[1], count))).sqrt() + _EPS
        return mean / (1 - torch.pow(_BETAS[0], count)) / size

    def _kept(self, weight: Tensor, name: str) -> Tensor:
        """A state of a weight, 0 at first."""
        if name not in self.state[weight]:
            self.state[weight][name] = torch.zeros_like(weight)
        kept: Tensor = self.state[weight][name]
        return kept


@cache
def half_precision(device: torch.device) -> torch.dtype:
    """bfloat16 where it is fast: processors without instructions for it take three (AVX-512) to
    sixty times as long as in float32, which it is there.
    """
    fast = device.type != "cpu" or get_host_cpu_features().get("avx512bf16", False)
    return torch.bfloat16 if fast else torch.float32


def orthogonal(matrix: Tensor) -> Tensor:
    """(M, N) with the same singular vectors and singular values between about 0.7 and 1.2."""
    a, b, c = _QUINTIC
    wide = matrix.shape[0] <= matrix.shape[1]
    x = (matrix if wide else matrix.mT).to(half_precision(matrix.device))
    x = x / (x.norm() + 1e-7)
    for _ in range(_ITERATIONS):
        square = x @ x.mT
        x = a * x + (b * square + c * square @ square) @ x
    return (x if wide else x.mT).to(matrix.dtype)
