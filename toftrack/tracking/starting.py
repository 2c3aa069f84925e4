"""The beginning of a track: where the hand may be, and whether that beats a young track."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from toftrack.compute.transfer import on_device, on_host
from toftrack.tracking.following import displacement, young
from toftrack.tracking.life_cycle import LostSettings, lasted, longer
from toftrack.tracking.model import ObservedFrame, TrackerModel
from toftrack.tracking.refining import Refined, improved
from toftrack.tracking.relocating import begun, track_of
from toftrack.tracking.search import LogScores, Sought
from toftrack.tracking.state import Track, TrackerState


@dataclass(frozen=True, eq=False)
class Proposals:
    """Where a frame's hand may be.

    particles: (N, 6 + d).
    log_scores: what they may be compared with others by; knows more than the image.
    """

    particles: Tensor
    log_scores: LogScores


def propose(state: TrackerState, frame: ObservedFrame, generator: torch.Generator) -> Proposals:
    """Particles to start with in a frame, from what the state still knows of the hand."""
    model, seen = frame.model, state.seen
    prior = model.start.prior(frame.observation, seen)

    def log_scores(particles: Tensor, coverage: float) -> Tensor:
        return frame.log_scores(model.decode(particles), coverage) + prior(particles)

    improve, motions = partial(improved, frame=frame), model.backend.motions
    sought = Sought(frame.observation, model.space, motions, log_scores, improve, seen)
    return Proposals(model.start(sought, model.filter.particles, generator), log_scores)


def begin(
    track: Track | None,
    state: TrackerState,
    dt_s: float,
    frame: ObservedFrame,
    generator: torch.Generator,
) -> Track:
    """The track to follow in a frame: the given one, or one that begins here."""
    model = frame.model
    if model.relocaliser is not None:
        return begun(frame) if track is None else track
    assert isinstance(model.lost, LostSettings)  # see TrackerModel
    if track is not None and not young(track, model.lost):
        return track
    return started(track, propose(state, frame, generator), dt_s, model)


def challenged(
    track: Track, outcome: Refined, dt_s: float, frame: ObservedFrame
) -> tuple[Track, Tensor, Tensor | None]:
    """The track, the pose (1, 27) and the trend to go on with, after a rival was heard.

    A rival takes over when it was better for a while; never while something hides the hand.
    """
    relocaliser, rival = frame.model.relocaliser, outcome.rival
    track = replace(track, contender=outcome.contender)
    if relocaliser is not None and frame.glance is None:
        return track, outcome.pose, outcome.trend
    if relocaliser is None or rival is None or frame.hidden:
        return replace(track, challenged_s=0.0), outcome.pose, outcome.trend
    since = longer(track.challenged_s, dt_s)
    if track.age_s > 0 and not lasted(since, relocaliser.settings.rival_frames):
        return replace(track, challenged_s=since), outcome.pose, outcome.trend
    return replace(track_of(rival, frame.model), believed=track.believed), rival, None


def started(track: Track | None, proposals: Proposals, dt_s: float, model: TrackerModel) -> Track:
    """A new track from a start; or the given young one, if the start is no better than it."""
    particles = proposals.particles
    if track is not None and isinstance(model.lost, LostSettings):
        ahead = displacement(track, dt_s, model.filter)
        (before,) = on_host(track.particles)
        now = model.backend.motions.compose(before, ahead[None])
        log_scores = proposals.log_scores
        # The search has seen this frame and the track has not, so a little better is no better.
        if log_scores(particles, 1.0).max() - log_scores(now, 1.0).max() < model.lost.rival_gain:
            return track
    n, size = particles.shape
    there = on_device(particles, model.device)
    weights = there.new_full((n,), 1.0 / n, dtype=torch.float64)
    return Track(there, weights, particles[:1], particles.new_zeros(size), particles.new_zeros(21))
