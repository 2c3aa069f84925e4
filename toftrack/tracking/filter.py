"""Prediction and particle filter of a track.

The filter itself is compute/particle_filter.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from toftrack.compute import particle_filter
from toftrack.compute.pace import FRAME_S, Spans
from toftrack.compute.particle_filter import FilterSettings
from toftrack.compute.rigid import bound, pivot_offset
from toftrack.compute.transfer import on_device
from toftrack.render.segmentation import Expected
from toftrack.tracking.model import FilterModel, FittedHand
from toftrack.tracking.posterior import ImageTerm
from toftrack.tracking.state import ParticleSet, Track, changed, generator_on

_MOVEMENT_S = 0.3
"""Time in which a predicted movement fades to 1/e."""
_APPROACH_M_S, _NEAREST_M = 0.05, 0.15
"""How much faster than its wrist the nearest joint of a partly hidden hand may approach the camera;
and the least depth of a predicted palm: no camera sees one nearer."""


def predicted_motion(track: Track, dt_s: float, settings: FilterSettings) -> Tensor:
    """(6 + d,) the tangent by which a hand is expected to move in dt_s.

    In FRAME_S it is the share `settings.velocity` of the motion by the track's velocity; over a
    longer time the share is smaller.
    """
    reach_s = FRAME_S * math.expm1(-dt_s / _MOVEMENT_S) / math.expm1(-FRAME_S / _MOVEMENT_S)
    return track.velocity * (settings.velocity * reach_s)


@dataclass(frozen=True, eq=False)
class PredictedHand:
    """A track's hand as it is predicted in a frame.

    track: as the last frame left it, but for `asked_s` and `evidence`, which are as of this frame.
    pose: (1, 27).  joints_m: (21, 3).  up_m: (3,) from its wrist to the palm's middle.
    palm_m: (3,) the palm's middle, by the hand's own length: the nearer to it a crop is centred,
        the more exact are the poses that the network sees there.
    expected: where it is to be segmented.
    """

    track: Track
    fitted: FittedHand
    pose: Tensor
    joints_m: Tensor
    palm_m: np.ndarray
    up_m: np.ndarray
    expected: Expected


def predict(track: Track, dt_s: float, model: FilterModel) -> PredictedHand:
    """A track's hand dt_s after its last frame: its wrist moved on, its finger angles unchanged."""
    fitted = model.hand(track.side, track.shape)
    moved = predicted_motion(track, dt_s, model.filter)
    tangent = torch.cat((moved[:6], moved.new_zeros(21)))[None]
    pose = model.backend.motions.compose(track.pose, tangent)
    joints = fitted.refiner.joints(pose)[0]
    palm, up = palm_of(pose, fitted)
    nearest, farthest = map(float, joints[:, 2].aminmax())
    # A hidden finger is free to move in front of what hides it, which would then be taken for the
    # hand: while something hides the hand, it comes nearer only as its middle does.
    approach = _APPROACH_M_S * dt_s + max(0.0, -float(moved[2]))
    nearest = max(nearest, track.nearest_m - approach)
    expected = Expected(nearest, farthest, tuple(joints.mean(0).tolist()))
    evidence = changed(track.evidence, age_s=track.evidence.age_s + dt_s)
    track = changed(track, asked_s=track.asked_s + dt_s, evidence=evidence)
    return PredictedHand(track, fitted, pose, joints, palm, up, expected)


def palm_of(pose: Tensor, fitted: FittedHand) -> tuple[np.ndarray, np.ndarray]:
    """(3,) m, the middle of the palm in a pose (1, 27); and (3,) m from the wrist to it."""
    wrist = pose[0, :6].numpy()
    up = np.float32(fitted.ratio) * pivot_offset(wrist[None, 3:])[0]
    palm = wrist[:3] + up
    palm[2] = max(palm[2], _NEAREST_M)
    return palm, up


def run_filter(
    tracks: Sequence[Track],
    dt_s: float,
    images: Sequence[ImageTerm],
    model: FilterModel,
    generators: Sequence[torch.Generator],
    spans: Spans,
) -> list[ParticleSet]:
    """The particles of B tracks after dt_s: predicted, resampled by the weights that they have,
    diffused, and weighed by each track's image, all of them in each call.

    Nothing within waits for the device, so that it is not held up between passes.
    """
    if not tracks:
        return []
    space, motions = model.space_of(tracks[0].cloud.particles), model.backend.motions
    scorers, evidences = [image.scorer for image in images], [image.evidence for image in images]

    def log_scores(particles: Tensor) -> Tensor:
        poses = model.decode(particles.flatten(0, 1)).unflatten(0, particles.shape[:2])
        with spans("filter: scoring"):
            return model.likelihood.log_score(model.backend.score_rows(scorers, poses, evidences))

    cfg, frames = model.filter, dt_s / FRAME_S
    moves = [predicted_motion(track, dt_s, cfg) for track in tracks]
    given = zip(tracks, moves, strict=True)
    # Of the first diffusion, which is wider the more a hand is expected to move.
    sigmas = [
        particle_filter.widened(model.sigmas, frames, moved, cfg.rest, cfg.speed_gain)
        for moved in moves
    ]
    particles, weights = particle_filter.annealed(
        torch.stack([_moved(track.cloud.particles, moved, model) for track, moved in given]),
        torch.stack([track.cloud.weights for track in tracks]),
        on_device(torch.stack(sigmas), model.device),
        log_scores,
        space.lower,
        space.upper,
        cfg,
        motions.redraw,
        [generator_on(model.device, generator) for generator in generators],
    )
    rows = zip(particles, weights, strict=True)
    return [ParticleSet(*row, motions.mean(*row)) for row in rows]


def _moved(particles: Tensor, tangent: Tensor, model: FilterModel) -> Tensor:
    """(N, 6 + d) particles, each moved by the same tangent (6 + d,)."""
    return model.backend.motions.compose(particles, on_device(tangent[None], model.device))


def predict_particles(track: Track, dt_s: float, model: FilterModel) -> ParticleSet:
    """A track's particles dt_s later, moved as predicted; weights and spread stay."""
    cloud, moved = track.cloud, predicted_motion(track, dt_s, model.filter)
    mean = model.backend.motions.compose(cloud.mean, moved[None])
    return changed(cloud, particles=_moved(cloud.particles, moved, model), mean=mean)


def shift_particles(filtered: ParticleSet, pose: Tensor, model: FilterModel) -> ParticleSet:
    """The particles, all moved by what moves their mean onto the particle of a pose (1, 27)."""
    motions, space = model.backend.motions, model.space_of(filtered.particles)
    mean = model.encode(pose)
    change = motions.difference(mean, filtered.mean)
    particles = motions.compose(filtered.particles, on_device(change, model.device))
    particles[:, 6:] = bound(particles[:, 6:], space.lower, space.upper, "truncate")
    return changed(filtered, particles=particles, mean=mean)


def update_velocity(track: Track, mean: Tensor, dt_s: float, model: FilterModel) -> Tensor:
    """(6 + d,) a second, the smoothed velocity of a track with a new mean; 0 in its first frame."""
    if not track.age.begun:
        return torch.zeros_like(track.velocity)
    moved = model.backend.motions.difference(mean, track.cloud.mean)[0]
    keep = model.filter.velocity_smoothing ** (dt_s / FRAME_S)
    return torch.lerp(moved / dt_s, track.velocity, keep)


def new_track(pose: Tensor, model: FilterModel) -> Track:
    """A track of age 0 at a pose (1, 27), with all particles there; without number and side."""
    particle = model.encode(pose)
    n = model.filter.particles
    particles = on_device(particle, model.device).repeat(n, 1)
    weights = particles.new_full((n,), 1.0 / n, dtype=torch.float64)
    still = particle.new_zeros(particle.shape[1])
    return Track(ParticleSet(particles, weights, particle), still, pose)
