"""The particle filter in the tracker: where a hand is predicted, filtered, and carried on.

The filter itself is compute/particle_filter.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from toftrack.compute import particle_filter
from toftrack.compute.pace import FRAME_S
from toftrack.compute.particle_filter import FilterSettings
from toftrack.compute.redraw import bound
from toftrack.compute.rigid import pivot_offset
from toftrack.compute.spans import Spans
from toftrack.compute.transfer import on_device
from toftrack.render.segmentation import Expected
from toftrack.tracking.model import FilterModel, FittedHand
from toftrack.tracking.posterior import ImageTerm
from toftrack.tracking.state import Track, generator_on

_MOVEMENT_S = 0.3
"""How long a movement goes on (to 1/e)."""
_APPROACH_M_S = 0.05
"""How much faster than its middle a partly hidden hand may come nearer, m/s."""
_NEAREST_M = 0.15
"""A camera sees nothing nearer."""


def predicted_motion(track: Track, dt_s: float, settings: FilterSettings) -> Tensor:
    """(6 + d,) how far a hand is expected to move on, in tangent coordinates.

    A movement fades: `settings.velocity` of it is expected in the first FRAME_S.
    """
    reach_s = FRAME_S * math.expm1(-dt_s / _MOVEMENT_S) / math.expm1(-FRAME_S / _MOVEMENT_S)
    return track.velocity * (settings.velocity * reach_s)


def predicted_palm(
    track: Track, dt_s: float, hand: FittedHand, model: FilterModel
) -> tuple[np.ndarray, np.ndarray]:
    """(1, 3) middle of a hand's palm, dt_s after the last frame, and (1, 3) where its fingers
    point, as long as from the wrist to there.

    Poses are the more exact the nearer the crop's centre is to the middle of the palm, so that a
    small hand's is not where a large one's would be.
    """
    moved = predicted_motion(track, dt_s, model.filter)[None]
    particle = model.backend.motions.compose(track.mean, moved).numpy()
    up = np.float32(hand.ratio) * pivot_offset(particle[:, 3:6])
    centre: np.ndarray = particle[:, :3] + up
    centre[:, 2] = np.maximum(centre[:, 2], _NEAREST_M)
    return centre, up


def predicted_depths(track: Track, dt_s: float, hand: FittedHand, model: FilterModel) -> Expected:
    """Where a hand is to be segmented, dt_s after the last frame."""
    moved = predicted_motion(track, dt_s, model.filter)
    joints = hand.refiner.joints(
        model.decode(model.backend.motions.compose(track.mean, moved[None]))
    )[0]
    nearest, farthest = map(float, joints[:, 2].aminmax())
    # A hidden finger is free to move in front of what hides it, which would then be taken for the
    # hand: while something hides the hand, it comes nearer only as its middle does.
    approach = _APPROACH_M_S * dt_s + max(0.0, -float(moved[2]))
    nearest = max(nearest, track.nearest_m - approach)
    return Expected(nearest, farthest, tuple(joints.mean(0).tolist()))


def run_filter(
    track: Track,
    dt_s: float,
    image: ImageTerm,
    model: FilterModel,
    generator: torch.Generator,
    spans: Spans,
) -> Filtered:
    """The filter's particles of a frame, weighed by the image.

    Nothing within waits for the device, so that it is not held up between passes.
    """
    space, motions = model.space_of(track.particles), model.backend.motions

    def log_scores(particles: Tensor) -> Tensor:
        states = model.decode(particles)
        with spans("filter: scoring"):
            return image(states)

    moved = predicted_motion(track, dt_s, model.filter)
    particles = motions.compose(track.particles, on_device(moved[None], model.device))
    sigmas = particle_filter.widened(
        model.sigmas, dt_s / FRAME_S, moved, model.filter.rest, model.filter.speed_gain
    )
    particles, weights = particle_filter.annealed(
        particles,
        track.weights,
        on_device(sigmas, model.device),
        log_scores,
        space.lower,
        space.upper,
        model.filter,
        motions.redraw,
        generator_on(model.device, generator),
    )
    return Filtered(particles, weights, motions.mean(particles, weights))


@dataclass(frozen=True, eq=False)
class Filtered:
    """What the filter makes of a frame.

    particles, weights: (N, 6 + d) and (N,), on the model's device.  mean: (1, 6 + d) of them.
    """

    particles: Tensor
    weights: Tensor
    mean: Tensor


@dataclass(frozen=True, eq=False)
class Found:
    """What a frame's filter and choice found.

    filtered: the particles.  pose: (1, 27) the estimate.  trend: (27,) see steadying.
    particle: (1, 6 + d) the pose in the pose space.  offset: (21,) rad, how far the pose lies off.
    """

    filtered: Filtered
    pose: Tensor
    trend: Tensor
    particle: Tensor
    offset: Tensor

    @property
    def off_rad(self) -> float:
        """How far the pose lies off the pose space, rms."""
        return float(self.offset.square().mean().sqrt())


def drawn_to(found: Found, model: FilterModel) -> Filtered:
    """The particles as they follow the estimate."""
    filtered, motions = found.filtered, model.backend.motions
    space = model.space_of(filtered.particles)
    change = motions.difference(found.particle, filtered.mean)
    particles = motions.compose(filtered.particles, on_device(change, model.device))
    latent = bound(particles[:, 6:], space.lower, space.upper, "truncate")
    particles[:, 6:] = latent
    return Filtered(particles, filtered.weights, found.particle)


def velocity_after(track: Track, mean: Tensor, dt_s: float, model: FilterModel) -> Tensor:
    """(6 + d,) a second, smoothed; 0 in a track's first frame."""
    if not track.age.begun:
        return torch.zeros_like(track.velocity)
    moved = model.backend.motions.difference(mean, track.mean)[0]
    keep = model.filter.velocity_smoothing ** (dt_s / FRAME_S)
    return torch.lerp(moved / dt_s, track.velocity, keep)


def new_track(pose: Tensor, model: FilterModel) -> Track:
    """A track that begins with a pose (1, 27), all particles in one place."""
    particle = model.encode(pose)
    n = model.filter.particles
    particles = on_device(particle, model.device).repeat(n, 1)
    weights = particles.new_full((n,), 1.0 / n, dtype=torch.float64)
    still = particle.new_zeros(particle.shape[1])
    return Track(particles, weights, particle, still, pose)
