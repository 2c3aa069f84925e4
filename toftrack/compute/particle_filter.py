"""Sequential importance resampling as pure functions on tensors (paper, section 2.3).

A particle is a row of an (N, 6 + d) tensor: the wrist's translation (3, m), rotation vector
(3, rad) and d latent coordinates; compute/rigid.py says how it is moved. Scores come as logarithms;
weights sum to 1. Every function that draws takes an explicit generator on the particles' device.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.compiling import entry_point
from toftrack.compute.rigid import BOUNDS, Redraw
from toftrack.errors import check_choice, check_number

RESAMPLERS = ("systematic", "stratified")


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

    def __post_init__(self) -> None:
        for field in fields(self):
            check_number(f"filter.spread.{field.name}", getattr(self, field.name), 0)

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

    def __post_init__(self) -> None:
        check_choice("filter.resampling", self.resampling, RESAMPLERS)
        check_choice("filter.bounds", self.bounds, BOUNDS)
        for name in ("particles", "passes"):
            check_number(f"filter.{name}", getattr(self, name), 1, whole=True)
        for name in ("exponent", "exponent_growth", "shrink"):
            check_number(f"filter.{name}", getattr(self, name), 0, above=True)
        for name in ("rest", "speed_gain", "velocity"):
            check_number(f"filter.{name}", getattr(self, name), 0)
        check_number("filter.velocity_smoothing", self.velocity_smoothing, 0, 1)


def widened(sigmas: Tensor, frames: float, movement: Tensor, rest: float, gain: float) -> Tensor:
    """Diffusion that follows the speed: a random walk at rest, whose spread grows with the root of
    the time, and that of a movement, which grows with the time.

    sigmas: (6 + d,) of a moderately moving hand in one frame of 1/25 s, of which `rest` is kept at
    rest.  frames: how many have passed.  movement: (6 + d,) tangent, how far it is expected to
    move.  gain: standard deviation per unit of movement; at most the sigmas a frame are doubled.
    """
    # In numpy: on ten numbers each of torch's operations takes longer than its arithmetic.
    moved, most = movement.numpy(), 2 * frames * sigmas.numpy()
    sizes = [math.sqrt(group @ group) for group in (moved[:3], moved[3:6], moved[6:])]
    length = np.repeat(np.array(sizes, most.dtype), (3, 3, len(moved) - 6))
    least = rest * math.sqrt(frames) * sigmas.numpy()
    return torch.from_numpy(np.minimum(least + gain * length, most))


def normalise(log_weights: Tensor) -> Tensor:
    """(..., N) log weights to weights that sum to 1 along N, float64.

    NaN counts as impossible. When no particle is possible, all are equally likely: the filter then
    diffuses on without evidence instead of failing.
    """
    if log_weights.device.type == "cpu":  # where each of torch's operations takes longer
        given = log_weights.double().numpy().reshape(-1, log_weights.shape[-1])
        weights = np.empty(given.shape)
        _normalise_rows(given, weights)
        return torch.from_numpy(weights.reshape(log_weights.shape))
    x = log_weights.double().nan_to_num(nan=-math.inf, neginf=-math.inf, posinf=1e300)
    most = x.amax(-1, keepdim=True)
    x = torch.where(most.isfinite(), (x - most).exp(), torch.ones_like(x))
    return x / x.sum(-1, keepdim=True)


@entry_point
def _normalise_rows(log_weights, weights):
    """See normalise; log_weights, weights: (B, N) float64."""
    for row in range(len(weights)):
        given, out = log_weights[row], weights[row]
        most, total = -np.inf, 0.0
        for i in range(len(out)):
            out[i] = min(given[i], 1e300) if given[i] > -np.inf else -np.inf  # also for NaN
            most = max(most, out[i])
        for i in range(len(out)):
            out[i] = math.exp(out[i] - most) if most > -np.inf else 1.0
            total += out[i]
        for i in range(len(out)):
            out[i] /= total


def effective_sample_size(weights: Tensor) -> Tensor:
    """1 / sum w^2 of normalised weights, between 1 and N; a scalar tensor."""
    return 1.0 / weights.square().sum()


def draw_positions(scheme: str, n: int, generator: torch.Generator) -> Tensor:
    """(n,) float64, ascending in 0 .. 1, of a scheme in RESAMPLERS.

    "systematic": equal steps from one uniform offset on. A particle of weight w then comes up floor
    or ceil(n w) times (Arulampalam et al. 2002, algorithm 2).  "stratified": one in each n-th.
    """
    device, count = generator.device, 1 if scheme == "systematic" else n
    offset = torch.rand(count, generator=generator, device=device, dtype=torch.float64)
    if device.type == "cpu":  # where each of torch's operations takes longer
        return torch.from_numpy((np.arange(n) + offset.numpy()) / n)
    return (torch.arange(n, device=device) + offset) / n


def annealed(
    particles: Tensor,
    weights: Tensor,
    sigmas: Tensor,
    log_scores: Callable[[Tensor], Tensor],
    lower: Tensor,
    upper: Tensor,
    settings: FilterSettings,
    redraw: Redraw,
    generators: Sequence[torch.Generator],
) -> tuple[Tensor, Tensor]:
    """Resample - diffuse - observe, in passes of shrinking diffusion and sharper weights.

    B hands at once, each with particles of its own.

    particles, weights: (B, M, 6 + d) predicted and (B, M) normalised.
    sigmas: (B, 6 + d) of the first pass's diffusion.
    log_scores: of the image, (B, N, 6 + d) to (B, N); their exponent grows.
    generators: B of them, so that what is drawn for a hand does not depend on others.
    Returns (B, N, 6 + d) and (B, N).
    """
    n, size, device = settings.particles, particles.shape[2], particles.device
    for number in range(settings.passes):
        drawn = []
        for row, generator in enumerate(generators):
            positions = draw_positions(settings.resampling, n, generator)
            noise = torch.randn((n, size), generator=generator, device=device)
            tangents = noise * (sigmas[row] * settings.shrink**number)
            given = particles[row], weights[row], positions, tangents
            drawn.append(redraw(*given, lower, upper, settings.bounds))
        particles = torch.stack(drawn)
        log_weights = settings.exponent * settings.exponent_growth**number * log_scores(particles)
        weights = normalise(log_weights)
    return particles, weights


def covariance(tangents: Tensor, weights: Tensor) -> Tensor:
    """Weighted covariance of tangent offsets about their own mean, (6 + d, 6 + d)."""
    w = weights.to(tangents.dtype)
    centred = tangents - w @ tangents
    return (centred * w[:, None]).mT @ centred
