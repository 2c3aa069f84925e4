"""Refinement in the tracker: hypotheses of a start, and the estimate of a frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from toftrack.refinement.gauss_newton import Refinement
from toftrack.refinement.proposals import exchange_fingers, swap_fingers
from toftrack.refinement.seen_points import seen_points
from toftrack.refinement.steadying import steadied
from toftrack.tracking.model import ObservedFrame
from toftrack.tracking.relocating import candidates, joints_word, known_scores, landmarks_of
from toftrack.tracking.signs import out_of_sight
from toftrack.tracking.state import Track

_CLOSE = 16
"""Of many poses, so many of the best by the image are compared by all that is known."""
_COVERED = 0.6
"""Share of the joints behind something from which on a hand stays where it was."""
_UNSEEN = 0.3
"""Share of the joints that must be out of sight for the networks not to be heard."""


def improved(particles: Tensor, frame: ObservedFrame) -> Tensor:
    """Hypotheses (N, 6 + d) brought onto the seen points, each by itself, and back to particles."""
    model, refiner = frame.model, frame.hand.refiner
    cfg = model.refinement
    if cfg is None:
        return particles
    states, seen = model.decode(particles), seen_points(frame.observation)
    return model.encode(refiner(states, states[:, 6:], seen, cfg))


@dataclass(frozen=True, eq=False)
class Refined:
    """A frame's estimate.

    pose: (1, 27).  trend: (27,) see steadying.
    rival: (1, 27) a pose of the networks that is another one, and better; None where there is none.
    """

    pose: Tensor
    trend: Tensor | None
    rival: Tensor | None = None


def refined(
    track: Track, mean: Tensor, dt_s: float, frame: ObservedFrame, generator: torch.Generator
) -> Refined:
    """The frame's estimate from the filter's mean (1, 6 + d)."""
    model = frame.model
    pose = model.decode(mean, track.offset)
    if model.refinement is None:
        return Refined(pose, track.trend)
    if track.pose is not None and model.relocaliser is not None and _covered(track.pose, frame):
        return Refined(track.pose, None)
    pose, rival = _onto_points(pose, track.pose, frame, model.refinement, generator)
    if track.pose is None:
        return Refined(pose, track.trend, rival)
    steadying, motions = model.refinement.steadying, model.backend.motions
    steady, trend = steadied(pose, track.pose, track.trend, dt_s, steadying, motions)
    return Refined(steady, trend, rival)


def _onto_points(
    state: Tensor,
    before: Tensor | None,
    frame: ObservedFrame,
    cfg: Refinement,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor | None]:
    """The filter's hand brought onto the seen points, (1, 27), and a rival; `before`: the last."""
    refiner, seen = frame.hand.refiner, seen_points(frame.observation)
    glance = None if before is not None and _mostly_unseen(state, frame) else frame.glance
    if glance is None:
        frame = replace(frame, glance=None)
    landmarks = None if glance is None else landmarks_of(glance, frame.model)

    def onto_points(starts: Tensor) -> Tensor:
        return refiner(starts, starts[:, 6:], seen, cfg, landmarks)

    starts = [state]
    if before is not None:
        # The pose of the last frame stands until another one is clearly better: what the image
        # does not decide, such as a hidden finger, must not flicker.
        starts.insert(0, torch.cat((state[:, :6], before[:, 6:]), 1))
    own = len(starts)
    if glance is not None:
        starts.append(candidates(glance, frame, frame.model.rivals))
    tried = onto_points(torch.cat(starts))
    scores = _scores(tried, frame)
    first = 0 if scores[0] + cfg.keep_gain >= scores[own - 1] else own - 1
    found, rival = tried[first][None], None
    if glance is not None and len(tried) > own:
        found, rival = _contested(found, tried[own:], scores[own:] - scores[first], frame)
    exchanged = [swap_fingers(found, frame.model.poses, cfg.swaps, generator)]
    if glance is not None:
        exchanged.append(exchange_fingers(found, torch.cat(starts)[own : own + 4, 6:]))
    tried = torch.cat(exchanged)
    scores = _scores(tried, frame)
    best = int(scores.argmax())
    if scores[best] <= scores[0] + cfg.swap_gain:
        return found, rival
    swapped = tried[best][None]
    both = torch.cat((swapped, onto_points(swapped)))
    return both[_scores(both, frame).argmax()][None], rival


def _covered(state: Tensor, frame: ObservedFrame) -> bool:
    """Whether something hides so much of a hand (1, 27) that it is best left where it was.

    What is still seen about it belongs to the thing that hides it, as often as not.
    """
    joints, image = frame.hand.refiner.joints(state)[0].cpu(), frame.observation
    return out_of_sight(joints, image.depth_m, image.k)[1] > _COVERED


def _mostly_unseen(state: Tensor, frame: ObservedFrame) -> bool:
    """Whether so much of a hand (1, 27) is out of sight that the networks know less than a track.

    What is hidden or cut off moves on as it did; the networks see another hand in the rest of it.
    """
    joints, image = frame.hand.refiner.joints(state)[0].cpu(), frame.observation
    return sum(out_of_sight(joints, image.depth_m, image.k)) > _UNSEEN


def _scores(states: Tensor, frame: ObservedFrame) -> Tensor:
    """What hands (N, 27) are compared by: the image, the networks' votes, room for the fingers."""
    scores = frame.log_scores(states)
    # What speaks against a pose never raises its score: it matters for the first few only.
    rows = torch.arange(len(states), device=states.device)
    if len(states) > _CLOSE:
        rows = torch.cat((rows[:1], scores[1:].topk(_CLOSE - 1).indices + 1))
    word = torch.full_like(scores, -torch.inf)
    word[rows] = joints_word(frame.hand.refiner.joints(states[rows]), frame)
    return scores + word


def _contested(
    found: Tensor, others: Tensor, gain: Tensor, frame: ObservedFrame
) -> tuple[Tensor, Tensor | None]:
    """The found pose or a better one beside it; and the best of those that are other poses.

    others: (R, 27) poses of the networks.  gain: (R,) their log scores less that of the found one.
    """
    relocaliser = frame.model.relocaliser
    assert relocaliser is not None and frame.glance is not None
    joints = frame.hand.refiner.joints(torch.cat((found, others)))
    away = (joints[1:] - joints[:1]).norm(dim=-1).mean(1)
    near = away < relocaliser.settings.rival_m
    rival = None
    if bool((~near).any()):
        scores = known_scores(torch.cat((found, others)), joints, frame)
        scores[1:][near] = -torch.inf
        best = int(scores[1:].argmax())
        if scores[1 + best] > scores[0] + relocaliser.settings.rival_gain:
            rival = others[best][None]
    gain = gain.masked_fill(~near, -torch.inf)
    best = int(gain.argmax())
    return (others[best][None] if gain[best] > 0 else found), rival
