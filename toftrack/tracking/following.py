"""How a track goes from frame to frame: where the hand is expected, filtered, and carried on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from toftrack.render.segmentation import Expected
from toftrack.tracking import particle_filter
from toftrack.tracking.life_cycle import Belief, LostSettings
from toftrack.tracking.model import ObservedFrame, SizedHand, TrackerModel
from toftrack.tracking.search import LastSeen
from toftrack.tracking.spans import Spans
from toftrack.tracking.state import Track

_APPROACH_M = 0.002
"""How much nearer than its middle's movement a partly hidden hand may come in a frame."""


def filtered(
    track: Track, frame: ObservedFrame, generator: torch.Generator, spans: Spans
) -> tuple[Tensor, Tensor]:
    """The filter's particles (N, 6 + d) and weights (N,) of a frame."""
    model = frame.model

    def log_scores(particles: Tensor) -> Tensor:
        states = model.decode(particles, track.offset)
        with spans("filter: scoring"):
            return frame.log_scores(states)

    particles = model.backend.motions.compose(track.particles, track.velocity[None])
    # A hand that was nearly lost is looked for farther away.
    width = 1.0 + track.bad
    sigmas = width * particle_filter.widened(
        model.sigmas, track.velocity, model.filter.rest, model.filter.speed_gain
    )
    return particle_filter.annealed(
        particles,
        track.weights,
        sigmas,
        log_scores,
        model.log_prior,
        model.space.lower,
        model.space.upper,
        model.filter,
        model.backend.motions,
        generator,
    )


@dataclass(frozen=True, eq=False)
class Found:
    """What a frame's filter and refinement found.

    particles, weights: the filter's, (N, 6 + d) and (N,).  mean: (1, 6 + d) of them.
    pose: (1, 27) refined.  trend: (27,) see steadying.
    refined: (1, 6 + d) the pose in the pose space.  offset: (21,) rad, how far the pose lies off.
    """

    particles: Tensor
    weights: Tensor
    mean: Tensor
    pose: Tensor
    trend: Tensor | None
    refined: Tensor
    offset: Tensor

    @property
    def off_rad(self) -> float:
        """How far the pose lies off the pose space, rms."""
        return float(self.offset.square().mean().sqrt())


def advanced(
    track: Track, found: Found, belief: Belief, expected: Expected | None, model: TrackerModel
) -> Track:
    """The track as of this frame.

    expected: where the hand was looked for, if something hides part of it.
    """
    cfg, motions = model.filter, model.backend.motions
    lower, upper = model.space.lower, model.space.upper
    particles, mean, offset = found.particles, found.mean, track.offset
    if model.refinement is not None:
        # The particles follow the refined estimate, and what the space cannot say of its pose
        # is remembered beside them.
        change = motions.difference(found.refined, mean)
        particles = motions.compose(particles, change)
        particles[:, 6:] = particle_filter.bound(particles[:, 6:], lower, upper, "truncate")
        mean, offset = found.refined, model.refinement.carry * found.offset
    velocity = torch.zeros_like(track.velocity)
    if track.age > 0:
        moved = motions.difference(mean, track.mean)[0]
        keep = cfg.velocity_smoothing
        velocity = keep * track.velocity + (1 - keep) * cfg.velocity * moved
    return Track(
        particles,
        found.weights,
        mean,
        velocity,
        offset,
        found.pose,
        found.trend,
        track.age + 1,
        belief.bad,
        belief.outside,
        expected,
    )


def remembered(
    seen: LastSeen | None, track: Track | None, belief: Belief, settings: LostSettings
) -> LastSeen | None:
    """The last hand that was believed, as of this frame."""
    if track is None or belief.lost or track.age <= settings.probation:
        return seen
    return LastSeen(track.mean, 0.0)


def aged(seen: LastSeen | None, seconds: float) -> LastSeen | None:
    """The same hand, longer ago."""
    return None if seen is None else replace(seen, age_s=seen.age_s + seconds)


def expected_depths(track: Track | None, hand: SizedHand, model: TrackerModel) -> Expected | None:
    """Where the next frame is looked for the hand, one movement ahead; None where there is none."""
    if track is None:
        return None
    ahead = model.decode(model.backend.motions.compose(track.mean, track.velocity[None]))
    nearest, farthest = map(float, hand.refiner.joints(ahead)[0, :, 2].aminmax())
    if track.expected is not None:
        # A hidden finger is free to move in front of what hides it, which would then be taken for
        # the hand: while something hides the hand, it comes nearer only as its middle does.
        approach = _APPROACH_M + max(0.0, -float(track.velocity[2]))
        nearest = max(nearest, track.expected.nearest_m - approach)
    return Expected(nearest, farthest)
