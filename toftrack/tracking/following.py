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
from toftrack.tracking.belief import CalibratedBelief
from toftrack.tracking.life_cycle import Belief, LostSettings, lasted, longer
from toftrack.tracking.model import ObservedFrame, SizedHand, TrackerModel
from toftrack.tracking.particle_filter import FilterSettings
from toftrack.tracking.search import LastSeen
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


def young(track: Track, settings: LostSettings) -> bool:
    """Whether a better start may still take a track's place."""
    return not lasted(track.age_s, settings.probation)


def filtered(
    track: Track, dt_s: float, frame: ObservedFrame, generator: torch.Generator, spans: Spans
) -> tuple[Tensor, Tensor]:
    """The filter's particles (N, 6 + d) and weights (N,) of a frame.

    Nothing within waits for the device, so that it is not held up between passes.
    """
    model, space = frame.model, frame.model.space_of(track.particles)
    offset = on_device(track.offset, model.device)

    def log_scores(particles: Tensor) -> Tensor:
        states = model.decode(particles, offset)
        with spans("filter: scoring"):
            return frame.log_scores(states)

    ahead = displacement(track, dt_s, model.filter)
    there = on_device(ahead[None], model.device)
    particles = model.backend.motions.compose(track.particles, there)
    # A hand that was nearly lost is looked for farther away, but not ever farther.
    width = 1.0 + (track.bad_s / FRAME_S if model.lost.patience else 0.0)
    sigmas = width * particle_filter.widened(
        model.sigmas, dt_s / FRAME_S, ahead, model.filter.rest, model.filter.speed_gain
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
    track: Track,
    found: Found,
    belief: Belief,
    expected: Expected | None,
    dt_s: float,
    model: TrackerModel,
) -> Track:
    """The track as of this frame, which comes dt_s after the last one.

    expected: where the hand was looked for, if something hides part of it.
    """
    cfg, motions = model.filter, model.backend.motions
    space = model.space_of(found.particles)
    particles, mean, offset = found.particles, found.mean, track.offset
    if model.refinement is not None:
        # The particles follow the refined estimate, and what the space cannot say of its pose
        # is remembered beside them.
        change = motions.difference(found.refined, mean)
        particles = motions.compose(particles, on_device(change, model.device))
        latent = particle_filter.bound(particles[:, 6:], space.lower, space.upper, "truncate")
        particles[:, 6:] = latent
        mean, offset = found.refined, model.refinement.carry * found.offset
    velocity = torch.zeros_like(track.velocity)
    if track.age_s > 0:
        moved = motions.difference(mean, track.mean)[0]
        keep = cfg.velocity_smoothing ** (dt_s / FRAME_S)
        velocity = torch.lerp(moved / dt_s, track.velocity, keep)
    return Track(
        particles=particles,
        weights=found.weights,
        mean=mean,
        velocity=velocity,
        offset=offset,
        pose=found.pose,
        trend=found.trend,
        contender=track.contender,
        age_s=longer(track.age_s, dt_s),
        bad_s=belief.bad_s,
        outside_s=belief.outside_s,
        challenged_s=track.challenged_s,
        log_odds=belief.log_odds,
        doubted=belief.lost,
        believed=track.believed or not belief.lost,
        unlooked_s=track.unlooked_s,
        signs=track.signs,
        joint_signs=track.joint_signs,
        expected=expected,
    )


def remembered(
    seen: LastSeen | None,
    track: Track | None,
    belief: Belief,
    settings: LostSettings | CalibratedBelief,
) -> LastSeen | None:
    """The last hand that was believed, as of this frame."""
    if track is None or belief.lost or not lasted(track.age_s, settings.probation + 1):
        return seen
    return LastSeen(track.mean, 0.0)


def aged(seen: LastSeen | None, seconds: float) -> LastSeen | None:
    """The same hand, longer ago."""
    return None if seen is None else replace(seen, age_s=seen.age_s + seconds)


def expected_depths(
    track: Track | None, dt_s: float, hand: SizedHand, model: TrackerModel
) -> Expected | None:
    """Where the hand is looked for, dt_s after the last frame; None where there is none."""
    if track is None:
        return None
    ahead = displacement(track, dt_s, model.filter)
    state = model.decode(model.backend.motions.compose(track.mean, ahead[None]))
    nearest, farthest = map(float, hand.refiner.joints(state)[0, :, 2].aminmax())
    if track.expected is not None:
        # A hidden finger is free to move in front of what hides it, which would then be taken for
        # the hand: while something hides the hand, it comes nearer only as its middle does.
        approach = _APPROACH_M_S * dt_s + max(0.0, -float(ahead[2]))
        nearest = max(nearest, track.expected.nearest_m - approach)
    if model.relocaliser is None:
        return Expected(nearest, farthest)
    middle = hand.refiner.joints(state)[0].mean(0)
    return Expected(nearest, farthest, tuple(middle.tolist()))
