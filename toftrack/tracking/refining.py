"""Refinement in the tracker: hypotheses of a start, and the estimate of a frame."""

from __future__ import annotations

import torch
from torch import Tensor

from toftrack.refinement.gauss_newton import Refinement
from toftrack.refinement.proposals import swap_fingers
from toftrack.refinement.seen_points import seen_points
from toftrack.refinement.steadying import steadied
from toftrack.tracking.model import ObservedFrame
from toftrack.tracking.state import Track


def improved(particles: Tensor, frame: ObservedFrame) -> Tensor:
    """Hypotheses (N, 6 + d) brought onto the seen points, each by itself, and back to particles."""
    model, refiner = frame.model, frame.hand.refiner
    cfg = model.refinement
    if cfg is None:
        return particles
    states, seen = model.decode(particles), seen_points(frame.observation)
    return model.encode(refiner(states, states[:, 6:], seen, cfg))


def refined(
    track: Track, mean: Tensor, dt_s: float, frame: ObservedFrame, generator: torch.Generator
) -> tuple[Tensor, Tensor | None]:
    """The frame's estimate from the filter's mean (1, 6 + d): pose (1, 27) and trend (27,)."""
    model = frame.model
    pose = model.decode(mean, track.offset)
    if model.refinement is None:
        return pose, track.trend
    pose = _onto_points(pose, track.pose, frame, model.refinement, generator)
    if track.pose is None:
        return pose, track.trend
    steadying, motions = model.refinement.steadying, model.backend.motions
    return steadied(pose, track.pose, track.trend, dt_s, steadying, motions)


def _onto_points(
    state: Tensor,
    before: Tensor | None,
    frame: ObservedFrame,
    cfg: Refinement,
    generator: torch.Generator,
) -> Tensor:
    """The filter's hand brought onto the seen points; `before` is the last one; (1, 27)."""
    refiner, seen = frame.hand.refiner, seen_points(frame.observation)

    def onto_points(starts: Tensor) -> Tensor:
        return refiner(starts, starts[:, 6:], seen, cfg)

    if before is None:
        found = onto_points(state)
    else:
        # The pose of the last frame stands until another one is clearly better: what the image
        # does not decide, such as a hidden finger, must not flicker.
        as_before = torch.cat((state[:, :6], before[:, 6:]), 1)
        both = onto_points(torch.cat((as_before, state)))
        scores = frame.log_scores(both)
        found = both[:1] if scores[0] + cfg.keep_gain >= scores[1] else both[1:]
    tried = swap_fingers(found, frame.model.poses, cfg.swaps, generator)
    scores = frame.log_scores(tried)
    best = int(scores.argmax())
    if scores[best] <= scores[0] + cfg.swap_gain:
        return found
    swapped = tried[best][None]
    both = torch.cat((swapped, onto_points(swapped)))
    return both[frame.log_scores(both).argmax()][None]
