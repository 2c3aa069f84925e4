"""Where in a pose space the training poses lie: a density to prefer natural poses by.

The box around the training poses is mostly empty, and "points far off the path can generate
unnatural poses" (paper, section 2.3). A kernel density (Parzen 1962, Rosenblatt 1956) of the
training latents says how far off a point is; mixed with a uniform density over the box, so that no
pose inside is ever forbidden.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from toftrack.errors import ToftrackError
from toftrack.pose_space.base import PoseSpace


@dataclass(frozen=True)
class LatentDensity:
    """A density over latent coordinates, in parts of its largest value at a training pose.

    scale: (d,) 1 / bandwidth a coordinate.  centres: (M, d) training latents times scale.
    log_peak: () the kernel density's largest log value at a training pose.
    floor: the density anywhere, in parts of the peak.
    """

    scale: Tensor
    centres: Tensor
    log_peak: Tensor
    floor: float

    def log_density(self, latent: Tensor) -> Tensor:
        """(N, d) to (N,): log density, about 0 on the path and log(floor) far off it.

        A particle filter adds it to a log weight: log w = exponent log score + strength * this.
        """
        log_kernel = _log_kernel(latent * self.scale, self.centres) - self.log_peak
        return torch.logaddexp(log_kernel, log_kernel.new_full((), math.log(self.floor)))


def latent_density(space: PoseSpace, bandwidth: float = 1.0, floor: float = 1e-3) -> LatentDensity:
    """The density of a space's training poses, on its device.

    bandwidth: in parts of Scott's rule, deviation * M ** (-1 / (d + 4)); smaller keeps closer to
        the path.
    floor: above 0; how much less than on the path a pose anywhere counts.

    Raises ToftrackError for a bandwidth or floor out of range.
    """
    if bandwidth <= 0 or not 0 < floor < 1:
        raise ToftrackError(
            f"a density with bandwidth {bandwidth:g} and floor {floor:g} is none; the bandwidth"
            " must be above 0 and the floor between 0 and 1"
        )
    latents = space.training_latents
    count, dims = latents.shape
    deviation = latents.std(0, correction=0).clamp(min=1e-6)
    scale = 1 / (bandwidth * deviation * count ** (-1 / (dims + 4)))
    centres = latents * scale
    return LatentDensity(scale, centres, _log_kernel(centres, centres).max(), floor)


def _log_kernel(points: Tensor, centres: Tensor) -> Tensor:
    """log sum_m exp(-|p - c_m|^2 / 2), (N, d) and (M, d) to (N,)."""
    square = (
        points.square().sum(1, keepdim=True) + centres.square().sum(1) - 2 * points @ centres.mT
    )
    return (-0.5 * square).logsumexp(1)
