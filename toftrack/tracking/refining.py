"""Refinement in the tracker: hypotheses of a start, and the estimate of a frame."""

from __future__ import annotations

import torch
from torch import Tensor

from toftrack.refinement.gauss_newton import Refinement, surroundings
from toftrack.refinement.proposals import swap_fingers
from toftrack.refinement.steadying import steadied
from toftrack.tracking.model import ObservedFrame
from toftrack.tracking.state import Track


def improved(particles: Tensor, frame: ObservedFrame) -> Tensor:
    """Hypotheses (N, 6 + d) brought onto the seen points, each by itself, and back to particles."""
    model, refiner = frame.model, frame.hand.refiner
    cfg = model.refinement
    if cfg is None:
        return particles
    states = model.decode(particles)
    for row in range(len(states)):
        state = states[row : row + 1]
        seen = surroundings(frame.observation, refiner.joints(state).mean(0), cfg.points)
        if len(seen.points_m):
            states[row] = refiner(state, state[:, 6:], seen, cfg)[0]
    return model.encode(states)


def refined(
    track: Track, mean: Tensor, frame: ObservedFrame, generator: torch.Generator
) -> tuple[Tensor, Tensor | None]:
    """The frame's estimate from the filter's mean (1, 6 + d): pose (1, 27) and trend (27,)."""
    model = frame.model
    pose = model.decode(mean, track.offset)
    if model.refinement is None:
        return pose, track.trend
    pose = _onto_points(pose, track.pose, frame, model.refinement, generator)
    if track.pose is None:
        return pose, track.trend
    return steadied(pose, track.pose, track.trend, model.refinement.steadying)


def _onto_points(
    state: Tensor,
    before: Tensor | None,
    frame: ObservedFrame,
    cfg: Refinement,
    generator: torch.Generator,
) -> Tensor:
    """The filter's hand brought onto the seen points; `before` is the last one; (1, 27)."""
    refiner = frame.hand.refiner
    seen = surroundings(frame.observation, refiner.joints(state).mean(0), cfg.points)
    if len(seen.points_m) == 0:
        return state

    def onto_points(start: Tensor) -> Tensor:
        return refiner(start, start[:, 6:], seen, cfg)

    found = onto_points(state)
    if before is not None:
        # The pose of the last frame stands until another one is clearly better: what the image
        # does not decide, such as a hidden finger, must not flicker.
        kept = onto_points(torch.cat((state[:, :6], before[:, 6:]), 1))
        scores = frame.log_scores(torch.cat((kept, found)))
        found = kept if scores[0] + cfg.keep_gain >= scores[1] else found
    tried = swap_fingers(found, frame.model.poses, cfg.swaps, generator)
    scores = frame.log_scores(tried)
    best = int(scores.argmax())
    if scores[best] <= scores[0] + cfg.swap_gain:
        return found
    swapped = tried[best][None]
    both = torch.cat((swapped, onto_points(swapped)))
    return both[frame.log_scores(both).argmax()][None]
