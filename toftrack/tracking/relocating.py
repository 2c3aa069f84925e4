"""The networks' part in a frame: where the hand is looked at, how a track begins, its rivals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.rigid import rotated_pivot
from toftrack.frames import DepthImage
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M
from toftrack.refinement.gauss_newton import Landmarks
from toftrack.refinement.seen_points import seen_points
from toftrack.relocation.relocaliser import Glance, Relocaliser
from toftrack.render.segmentation import Expected
from toftrack.tracking.model import ObservedFrame, SizedHand, TrackerModel
from toftrack.tracking.search import LastSeen
from toftrack.tracking.state import Track

_UNLIKELY = 0.03
"""Hypotheses that are less probable are no rivals."""
_NEAREST_M = 0.15
"""A camera sees nothing nearer."""


def glanced(
    track: Track | None, side: str, image: DepthImage, model: TrackerModel
) -> Glance | None:
    """What the networks say of a frame: at the tracked hand, or the best place of all.

    None where there are no networks, or no hand.
    """
    relocaliser = model.relocaliser
    if relocaliser is None:
        return None
    if track is None:
        return next(iter(relocaliser.search(image.depth_m, image.k, side)), None)
    ahead = model.backend.motions.compose(track.mean, track.velocity[None])
    centre = (ahead[:, :3] + rotated_pivot(ahead[:, 3:6])).cpu().numpy()
    centre[:, 2] = np.maximum(centre[:, 2], _NEAREST_M)
    return relocaliser.glance(image.depth_m, image.k, centre, side)[0]


def expected_of(glance: Glance) -> Expected:
    """Where a hand is to be segmented that is not tracked yet."""
    joints = glance.joints_m[0]
    nearest, farthest = map(float, joints[:, 2].aminmax())
    return Expected(nearest, farthest, tuple(glance.centre_m.tolist()))


def landmarks_of(glance: Glance, relocaliser: Relocaliser) -> Landmarks:
    """The network's joints as the refinement takes them."""
    cfg, found = relocaliser.settings, glance.landmarks
    sigma = (cfg.landmark_sigmas * found.sigma_m).clamp(min=cfg.landmark_m)
    return Landmarks(found.points_m, sigma)


def hypotheses(glance: Glance, hand: SizedHand, count: int) -> tuple[Tensor, Tensor]:
    """The likeliest (H, 27) as states of a hand, and their log probabilities (H,)."""
    device = hand.shape.base_m.device
    ratio = hand.shape.hand_length_m / DEFAULT_HAND_LENGTH_M
    likely = int((glance.log_probability > np.log(_UNLIKELY)).sum())
    kept = glance.first(max(1, min(count, likely)))
    return kept.states(ratio).to(device), kept.log_probability.to(device)


@dataclass(frozen=True, eq=False)
class Contender:
    """A pose of the networks and what speaks for it.

    pose: (1, 27) refined.  log_score: with all that is known besides the image.
    """

    pose: Tensor
    log_score: float


def contenders(
    glance: Glance, frame: ObservedFrame, seen: LastSeen | None, count: int
) -> tuple[Tensor, Tensor]:
    """The networks' poses (H, 27), refined, and their log scores (H,) with all that is known."""
    model, relocaliser = frame.model, frame.model.relocaliser
    assert relocaliser is not None
    states, log_probability = hypotheses(glance, frame.hand, count)
    if model.refinement is not None:
        points = seen_points(frame.observation)
        landmarks = landmarks_of(glance, relocaliser)
        better = frame.hand.refiner(states, states[:, 6:], points, model.refinement, landmarks)
        states, log_probability = torch.cat((states, better)), log_probability.repeat(2)
    prior = model.start.prior(frame.observation, seen)
    scores = frame.log_scores(states, 1.0) + prior(states)
    return states, scores + relocaliser.settings.prior * log_probability


def begun(glance: Glance, frame: ObservedFrame, seen: LastSeen | None) -> Track:
    """A track that begins with the best of the networks' poses."""
    relocaliser = frame.model.relocaliser
    assert relocaliser is not None
    states, scores = contenders(glance, frame, seen, relocaliser.settings.hypotheses)
    return track_of(states[scores.argmax()][None], frame.model)


def track_of(pose: Tensor, model: TrackerModel) -> Track:
    """A track that begins with a pose (1, 27)."""
    particle, off = model.nearest(pose)
    n = model.filter.particles
    particles = particle.repeat(n, 1)
    weights = particles.new_full((n,), 1.0 / n, dtype=torch.float64)
    carry = 0.0 if model.refinement is None else model.refinement.carry
    still = particles.new_zeros(particles.shape[1])
    return Track(particles, weights, particle, still, carry * off, pose)
