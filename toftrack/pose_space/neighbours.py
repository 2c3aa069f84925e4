"""Spaces whose coordinates are known only at the training poses: a new pose asks its neighbours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from toftrack.errors import ToftrackError
from toftrack.pose_space.kernel_decoder import (
    KernelDecodedSpace,
    Regression,
    fit_regression,
    regression_tensors,
    tensor32,
)

RIDGE = 1e-2
"""Regularises the weights of neighbours, in parts of their squared distances."""


@dataclass(frozen=True, eq=False)
class NeighbourSpace(KernelDecodedSpace):
    """latent = weighted mean of the nearest poses' latents, angles by kernel regression.

    poses: (M, 21) rad.  neighbours: () their number.
    """

    poses: Tensor
    neighbours: Tensor

    @cached_property
    def _count(self) -> int:
        """Read once, so that encoding does not wait for the device."""
        return int(self.neighbours)

    def encode(self, angles: Tensor) -> Tensor:
        """(N, 21) radians to (N, d), by the weights that make up the pose from its neighbours."""
        nearest, weights = barycentric_weights(angles, self.poses, self._count)
        return torch.einsum("nk,nkd->nd", weights, self.training_latents[nearest])


def barycentric_weights(angles: Tensor, poses: Tensor, neighbours: int) -> tuple[Tensor, Tensor]:
    """The nearest poses and the weights, summing to 1, that make up each pose best.

    The constrained least squares of locally linear embedding (Saul and Roweis, J. Mach. Learn. Res.
    4, 2003, section 5), regularised by RIDGE times each neighbour's own squared distance, so that
    nearer ones come first and a training pose is made of itself alone.

    angles: (N, 21).  poses: (M, 21).  Returns indices (N, k) and weights (N, k).
    """
    # Differences, not products: float32 must still tell a pose from itself.
    distance = (angles[:, None] - poses).square().sum(-1)
    nearest = distance.topk(neighbours, dim=1, largest=False).indices
    offsets = poses[nearest] - angles[:, None]  # (N, k, 21)
    gram = offsets @ offsets.mT
    loading = (RIDGE * gram.diagonal(dim1=1, dim2=2)).clamp(min=1e-9)
    ones = gram.new_ones(len(gram), neighbours, 1)
    weights = torch.linalg.solve(gram + torch.diag_embed(loading), ones)[..., 0]
    return nearest, weights / weights.sum(1, keepdim=True)


def fit_neighbour_space(
    space: type[NeighbourSpace],
    embed: Callable[[np.ndarray, int], np.ndarray],
    angles: Tensor,
    labels: tuple[str, ...],
    dims: int,
    neighbours: int | None,
    candidates: tuple[int, ...],
) -> NeighbourSpace:
    """The space whose cross-validated map back to angles is best among numbers of neighbours.

    embed: (M, 21) poses and a number of neighbours to (M, dims) coordinates, float64.
    neighbours: the only number to try; None tries the candidates.

    Raises ToftrackError when there are too few poses for so many dimensions or neighbours.
    """
    x = angles.double().cpu().numpy()
    most = len(x) - 1
    if not 1 <= dims < most:
        raise ToftrackError(
            f"pose_space.dims={dims} cannot be learned from {len(x)} poses; give 1 to {most - 1}"
        )
    if neighbours is not None and not dims < neighbours <= most:
        raise ToftrackError(
            f"pose_space.neighbours={neighbours} must be above the {dims} dimensions and at most"
            f" {most} for {len(x)} poses, or null"
        )
    numbers = {min(max(k, dims + 1), most) for k in candidates}
    best: tuple[Regression, np.ndarray, int] | None = None
    for number in (neighbours,) if neighbours else sorted(numbers):
        latents = embed(x, number)
        # The sign of a coordinate is arbitrary: the largest entry is made positive.
        latents = latents * np.sign(latents[np.abs(latents).argmax(0), np.arange(dims)])
        regression = fit_regression(latents, x)
        if best is None or regression.error_rad < best[0].error_rad:
            best = regression, latents, number
    assert best is not None
    regression, latents, number = best
    return space(
        **regression_tensors(regression, latents, labels),
        poses=tensor32(x),
        neighbours=torch.tensor(float(number)),
    )
