"""The latent point in the box that describes a pose best: what a search of the box could find."""

from __future__ import annotations

import torch
from torch import Tensor

from toftrack.pose_space.base import PoseSpace

_STEP = 1e-4
"""Of the differences that stand for derivatives, in parts of the box."""


def nearest_latents(space: PoseSpace, angles: Tensor, iterations: int = 25) -> Tensor:
    """Latent coordinates within the bounds whose decoded angles are nearest, (N, 21) to (N, d).

    `encode` answers another question: it is exact for PCA only, and need not stay in the box. Here
    Levenberg-Marquardt on |decode(z) - x|^2, in parts of the box and projected on it, starts from
    the encoded pose and from the nearest training pose; the better end counts.

    float64 on the CPU, as everything that this is for.
    """
    space = space.to("cpu", torch.float64)
    angles = angles.double().cpu()
    lower, span = space.lower, (space.upper - space.lower).clamp(min=1e-12)
    training = space.decode(space.training_latents)
    starts = (
        space.encode(angles),
        space.training_latents[torch.cdist(angles, training).argmin(1)],
    )
    ends = [
        _descend(space, angles, ((start - lower) / span).clamp(0, 1), iterations)
        for start in starts
    ]
    first, second = (_squared(space, end, angles) for end in ends)
    best = torch.where((first <= second)[:, None], ends[0], ends[1])
    return lower + span * best


def _decode(space: PoseSpace, unit: Tensor) -> Tensor:
    return space.decode(space.lower + unit * (space.upper - space.lower))


def _squared(space: PoseSpace, unit: Tensor, angles: Tensor) -> Tensor:
    return (_decode(space, unit) - angles).square().sum(1)


def _descend(space: PoseSpace, angles: Tensor, unit: Tensor, iterations: int) -> Tensor:
    damping = unit.new_full((len(unit), 1), 1e-2)
    value = _squared(space, unit, angles)
    steps = _STEP * torch.eye(space.dims, dtype=unit.dtype)
    for _ in range(iterations):
        here = _decode(space, unit)
        columns = [(_decode(space, unit + step) - here) / _STEP for step in steps]
        jacobian = torch.stack(columns, -1)  # (N, 21, d)
        right = (jacobian.mT @ (angles - here)[..., None])[..., 0]
        # On a bound and pushed outwards: that coordinate stays where it is.
        stuck = ((unit <= 0) & (right < 0)) | ((unit >= 1) & (right > 0))
        normal = jacobian.mT @ jacobian
        normal = normal.masked_fill(stuck[:, None] | stuck[..., None], 0.0)
        normal = normal + torch.diag_embed(damping.expand_as(unit) + stuck.double())
        moved = unit + torch.linalg.solve(normal, right.masked_fill(stuck, 0.0))
        moved = moved.clamp(0, 1)
        new = _squared(space, moved, angles)
        better = new < value
        unit = torch.where(better[:, None], moved, unit)
        value = torch.where(better, new, value)
        damping = torch.where(better[:, None], damping / 3, damping * 4).clamp(1e-9, 1e6)
    return unit
