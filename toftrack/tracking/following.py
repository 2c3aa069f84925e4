"""How a track goes from frame to frame: where the hand is expected, filtered, and carried on."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from toftrack.compute.pace import FRAME_S
from toftrack.compute.transfer import on_device
from toftrack.render.segmentation import Expected
from toftrack.tracking import particle_filter
from toftrack.tracking.life_cycle import Status, extended, reached
from toftrack.tracking.model import FilterModel, ObservedFrame, SizedHand
from toftrack.tracking.particle_filter import FilterSettings
from toftrack.tracking.prior import LastSeen
from toftrack.tracking.spans import Spans
from toftrack.tracking.state import Track, generator_on

_MOVEMENT_S = 0.3
"""How long a movement goes on (to 1/e)."""
_APPROACH_M_S = 0.05
"""How much faster than its middle a partly hidden hand may come nearer, m/s."""


def displacement(track: Track, dt_s: float, settings: FilterSettings) -> Tensor:
    """(6 + d,) how far a hand is expected to move on, in tangent coordinates.

    A movement fades: `settings.velocity` of it is expected in the first FRAME_S.
    """
    reach_s = FRAME_S * math.expm1(-dt_s / _MOVEMENT_S) / math.expm1(-FRAME_S / _MOVEMENT_S)
    return track.velocity * (settings.velocity * reach_s)


def filtered(
    track: Track,
    dt_s: float,
    frame: ObservedFrame,
    generator: torch.Generator,
    spans: Spans,
    width: float = 1.0,
) -> tuple[Tensor, Tensor]:
    """The filter's particles (N, 6 + d) and weights (N,) of a frame.

    width: times as far the particles are diffused as usual.

    Nothing within waits for the device, so that it is not held up between passes.
    """
    model, space = frame.model, frame.model.space_of(track.particles)
    offset = on_device(track.offset, model.device)

    def log_scores(particles: Tensor) -> Tensor:
        states = model.decode(particles, offset)
        with spans("filter: scoring"):
            return frame.log_scores(states)

    predicted = displacement(track, dt_s, model.filter)
    there = on_device(predicted[None], model.device)
    particles = model.backend.motions.compose(track.particles, there)
    sigmas = width * particle_filter.widened(
        model.sigmas, dt_s / FRAME_S, predicted, model.filter.rest, model.filter.speed_gain
    )
    return particle_filter.annealed(
        particles,
        track.weights,
        on_device(sigmas, model.device),
        log_scores,
        model.log_prior,
        space.lower,
        space.upper,
        model.filter,
        model.backend.motions.redraw,
        generator_on(model.device, generator),
    )


@dataclass(frozen=True, eq=False)
class Found:
    """What a frame's filter and refinement found.

    particles, weights: the filter's, (N, 6 + d) and (N,), on the model's device.
    mean: (1, 6 + d) of them.
    pose: (1, 27) refined.  trend: (27,) see steadying.
    refined: (1, 6 + d) the pose in the pose space.  offset: (21,) rad, how far the pose lies off.
    carried: (21,) rad, by how much the next frame's hypotheses are displaced.
    """

    particles: Tensor
    weights: Tensor
    mean: Tensor
    pose: Tensor
    trend: Tensor | None
    refined: Tensor
    offset: Tensor
    carried: Tensor

    @property
    def off_rad(self) -> float:
        """How far the pose lies off the pose space, rms."""
        return float(self.offset.square().mean().sqrt())


def drawn_to(found: Found, carry: float, model: FilterModel) -> Found:
    """The particles follow the refined pose; what the space cannot say of it is remembered beside
    them, but for a part: `carry` of it is kept.
    """
    motions, space = model.backend.motions, model.space_of(found.particles)
    change = motions.difference(found.refined, found.mean)
    particles = motions.compose(found.particles, on_device(change, model.device))
    latent = particle_filter.bound(particles[:, 6:], space.lower, space.upper, "truncate")
    particles[:, 6:] = latent
    return replace(found, particles=particles, mean=found.refined, carried=carry * found.offset)


def advanced(
    track: Track,
    found: Found,
    belief: Status,
    expected: Expected | None,
    dt_s: float,
    model: FilterModel,
) -> Track:
    """The track as of this frame, which comes dt_s after the last one.

    expected: where the hand was looked for, if something hides part of it.
    """
    velocity = torch.zeros_like(track.velocity)
    if track.age_s > 0:
        moved = model.backend.motions.difference(found.mean, track.mean)[0]
        keep = model.filter.velocity_smoothing ** (dt_s / FRAME_S)
        velocity = torch.lerp(moved / dt_s, track.velocity, keep)
    return replace(
        track,
        particles=found.particles,
        weights=found.weights,
        mean=found.mean,
        velocity=velocity,
        offset=found.carried,
        pose=found.pose,
        trend=found.trend,
        age_s=extended(track.age_s, dt_s),
        bad_s=belief.bad_s,
        log_odds=belief.log_odds,
        doubted=belief.lost,
        believed=track.believed or not belief.lost,
        expected=expected,
    )


def remembered(
    seen: LastSeen | None, track: Track, belief: Status, probation: int
) -> LastSeen | None:
    """The last hand that was believed, as of this frame; a new track waits `probation` frames."""
    if belief.lost or not reached(track.age_s, probation + 1):
        return seen
    return LastSeen(track.mean, 0.0)


def expected_depths(
    track: Track | None, dt_s: float, hand: SizedHand, model: FilterModel
) -> Expected | None:
    """Where the hand is looked for, dt_s after the last frame; None where there is none."""
    if track is None:
        return None
    predicted = displacement(track, dt_s, model.filter)
    state = model.decode(model.backend.motions.compose(track.mean, predicted[None]))
    nearest, farthest = map(float, hand.refiner.joints(state)[0, :, 2].aminmax())
    if track.expected is not None:
        # A hidden finger is free to move in front of what hides it, which would then be taken for
        # the hand: while something hides the hand, it comes nearer only as its middle does.
        approach = _APPROACH_M_S * dt_s + max(0.0, -float(predicted[2]))
        nearest = max(nearest, track.expected.nearest_m - approach)
    middle = hand.refiner.joints(state)[0].mean(0)
    return Expected(nearest, farthest, tuple(middle.tolist()))
