"""Sequential importance resampling as pure functions on tensors (paper, section 2.3).

A particle is a row of an (N, 6 + d) tensor: the wrist's translation (3, m), rotation vector (3,
rad)
and d latent coordinates. Weights are kept as logarithms until they are used. Every function that
draws takes an explicit generator on the particles' device.

Differences between particles are taken in the tangent space of a reference: translation of the
pivot, rotation vector of R R_ref', latent difference. The pivot is a point in the middle of the
hand, so that turning the hand does not also carry it away, as turning about the wrist would.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from toftrack.compute.backend import Motions
from toftrack.compute.rigid import MOTIONS, PIVOT_M, mean_rotation, rotated_pivot
from toftrack.errors import ToftrackError

__all__ = ["PIVOT_M", "mean_rotation", "rotated_pivot"]


@dataclass(frozen=True)
class Spread:
    """Standard deviations of a diffusion.

    translation_m, depth_m: across and along the optical axis.  rotation_rad: about every axis.
    latent: in parts of each coordinate's range between its bounds.
    """

    translation_m: float
    depth_m: float
    rotation_rad: float
    latent: float

    def sigmas(self, lower: Tensor, upper: Tensor) -> Tensor:
        """(6 + d,) standard deviations in tangent coordinates."""
        t, z, r = self.translation_m, self.depth_m, self.rotation_rad
        pose = torch.tensor([t, t, z, r, r, r], dtype=lower.dtype, device=lower.device)
        return torch.cat((pose, self.latent * (upper - lower)))


@dataclass(frozen=True)
class FilterSettings:
    """How the particles are resampled, moved and weighted; see conf/filter for what each does."""

    particles: int
    passes: int
    exponent: float
    exponent_growth: float
    shrink: float
    spread: Spread
    rest: float
    speed_gain: float
    velocity: float
    velocity_smoothing: float
    resampling: str
    bounds: str
    density: float = 0.0

    def __post_init__(self) -> None:
        if self.resampling not in RESAMPLERS:
            raise ToftrackError(
                f"filter.resampling={self.resampling} is unknown; give one of"
                f" {', '.join(RESAMPLERS)}"
            )
        if self.particles < 1 or self.passes < 1:
            raise ToftrackError("filter.particles and filter.passes must be at least 1")
        if not 0 <= self.density < math.inf:
            raise ToftrackError("filter.density must be 0 or more")


def widened(sigmas: Tensor, velocity: Tensor, rest: float, gain: float) -> Tensor:
    """Diffusion that follows the speed: narrow for a hand at rest, wide for a fast one.

    sigmas: (6 + d,) for a moderately moving hand.  velocity: (6 + d,) tangent, a frame.
    rest: part of the sigmas that a hand at rest keeps, 1 = the same at any speed.
    gain: standard deviation gained per unit of speed; at most the sigmas are doubled.
    """
    groups = torch.split(velocity, (3, 3, velocity.shape[0] - 6))
    speed = torch.cat([group.norm().expand(group.shape) for group in groups])
    return torch.minimum(rest * sigmas + gain * speed, 2 * sigmas)


def normalise(log_weights: Tensor) -> Tensor:
    """(N,) log weights to weights that sum to 1, float64.

    NaN counts as impossible. When no particle is possible, all are equally likely: the filter then
    diffuses on without evidence instead of failing.
    """
    w = log_weights.double().nan_to_num(nan=-math.inf, neginf=-math.inf, posinf=1e300)
    top = w.max()
    w = torch.where(top.isfinite(), (w - top).exp(), torch.ones_like(w))
    return w / w.sum()


def effective_sample_size(weights: Tensor) -> Tensor:
    """1 / sum w^2 of normalised weights, between 1 and N; a scalar tensor."""
    return 1.0 / weights.square().sum()


def resample_systematic(weights: Tensor, n: int, generator: torch.Generator) -> Tensor:
    """n indices drawn with one uniform offset and equal steps; index i comes up floor or ceil(n
    w_i)
    times (Arulampalam et al. 2002, algorithm 2). Returns (n,) int64, ascending.
    """
    offset = torch.rand(1, generator=generator, device=weights.device, dtype=torch.float64)
    return _pick(weights, torch.arange(n, device=weights.device) + offset, n)


def resample_stratified(weights: Tensor, n: int, generator: torch.Generator) -> Tensor:
    """n indices, one draw in each n-th of the unit interval. Returns (n,) int64, ascending."""
    offset = torch.rand(n, generator=generator, device=weights.device, dtype=torch.float64)
    return _pick(weights, torch.arange(n, device=weights.device) + offset, n)


def _pick(weights: Tensor, positions: Tensor, n: int) -> Tensor:
    total = weights.double().cumsum(0)
    # Relative to the sum that was really reached, so that rounding cannot leave a gap at the end.
    indices = torch.searchsorted(total, positions / n * total[-1], right=True)
    # The last index that has weight: one past the end is only ever a rounding.
    last = torch.searchsorted(total, total[-1:])
    return torch.minimum(indices, last)


RESAMPLERS: dict[str, Callable[[Tensor, int, torch.Generator], Tensor]] = {
    "systematic": resample_systematic,
    "stratified": resample_stratified,
}


def compose(reference: Tensor, tangent: Tensor) -> Tensor:
    """See rigid.compose."""
    return _motions(reference).compose(reference, tangent)


def difference(particles: Tensor, reference: Tensor) -> Tensor:
    """See rigid.difference."""
    return _motions(particles).difference(particles, reference)


def _motions(particles: Tensor) -> Motions:
    if particles.device.type != "cpu" or particles.dtype != torch.float32:
        return MOTIONS
    return _compiled()


@functools.cache
def _compiled() -> Motions:
    try:
        from toftrack.compute import rigid_numba
    except ImportError:
        return MOTIONS
    return rigid_numba.motions()


def bound(latent: Tensor, lower: Tensor, upper: Tensor, mode: str) -> Tensor:
    """Keep latent coordinates in their box, (N, d).

    "truncate" moves what is outside onto the bound, as the paper, which draws estimates near a
    bound away from where they should be and piles particles up on it; "reflect" folds it back.
    """
    if mode == "truncate":
        return torch.minimum(torch.maximum(latent, lower), upper)
    if mode == "reflect":
        width = upper - lower
        folded = torch.remainder(latent - lower, 2 * width)
        return lower + torch.minimum(folded, 2 * width - folded)
    raise ToftrackError(f"filter.bounds={mode} is unknown; give truncate or reflect")


def diffuse(
    particles: Tensor,
    scale: Tensor,
    lower: Tensor,
    upper: Tensor,
    mode: str,
    generator: torch.Generator,
) -> Tensor:
    """Move every particle by Gaussian noise inside the bounds of the pose space.

    scale: (6 + d,) standard deviations, or (6 + d, 6 + d) a lower triangular factor of the
        covariance, in tangent coordinates.
    """
    noise = torch.randn(
        particles.shape, generator=generator, device=particles.device, dtype=particles.dtype
    )
    moved = compose(particles, noise * scale if scale.dim() == 1 else noise @ scale.mT)
    moved[:, 6:] = bound(moved[:, 6:], lower, upper, mode)
    return moved


def annealed(
    particles: Tensor,
    weights: Tensor,
    sigmas: Tensor,
    log_scores: Callable[[Tensor], Tensor],
    log_prior: Callable[[Tensor], Tensor | None],
    lower: Tensor,
    upper: Tensor,
    settings: FilterSettings,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Resample - diffuse - observe, in passes of shrinking diffusion and sharper weights.

    particles, weights: (M, 6 + d) predicted and (M,) normalised.
    sigmas: (6 + d,) of the first pass's diffusion.
    log_scores: of the image, (N, 6 + d) to (N,); their exponent grows.
    log_prior: what else speaks for particles, (N,), in every pass alike; may say None.
    Returns (N, 6 + d) and (N,).
    """
    for number in range(settings.passes):
        chosen = RESAMPLERS[settings.resampling](weights, settings.particles, generator)
        scale = sigmas * settings.shrink**number
        particles = diffuse(particles[chosen], scale, lower, upper, settings.bounds, generator)
        log_weights = settings.exponent * settings.exponent_growth**number * log_scores(particles)
        prior = log_prior(particles)
        weights = normalise(log_weights if prior is None else log_weights + prior)
    return particles, weights


def mean_particle(particles: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean, (N, 6 + d) and (N,) to (1, 6 + d), the rotation averaged on SO(3)."""
    mean = (weights.to(particles.dtype) @ particles)[None]
    mean[0, 3:6] = mean_rotation(particles[:, 3:6], weights)
    return mean


def covariance(tangents: Tensor, weights: Tensor) -> Tensor:
    """Weighted covariance of tangent offsets about their own mean, (6 + d, 6 + d)."""
    w = weights.to(tangents.dtype)
    centred = tangents - w @ tangents
    return (centred * w[:, None]).mT @ centred
