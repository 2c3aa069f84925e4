"""Which of several poses is the hand's: as it was, as the networks see it, or with other fingers.

A pose whose fingers are others must prove itself. One image often says as much for a pose as for
the same with the neighbouring finger, and what is a little better changes from frame to frame; so
the lead of such a contender is summed up over frames, as in a sequential test (Page, "Continuous
inspection schemes", Biometrika 41, 1954), and it takes over when the lead is large enough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from toftrack.compute.pace import FRAME_S
from toftrack.refinement.gauss_newton import Refinement
from toftrack.refinement.proposals import exchange_fingers, swap_fingers
from toftrack.tracking.detect import joints_log_prior, log_posterior
from toftrack.tracking.model import DetectedFrame
from toftrack.tracking.state import Contender, Track

_CLOSE = 16
"""Of many poses, so many of the best by the image are compared by all that is known."""
_SWAPPED = 2
"""So many poses with another finger are refined."""
_OTHER_M = 0.025
"""Poses with a joint that is farther off are other ones."""
_PAUSE_S = 0.06
"""A time between two frames that is not the usual one."""
_LEAST_CREDIT = 0.2
"""Of what a contender needs against a track that is believed, it needs so much against any."""


@dataclass(frozen=True, eq=False)
class Alternatives:
    """Poses (N, 27) and what they are compared by, (N,)."""

    poses: Tensor
    scores: Tensor

    def rows(self, rows: Tensor) -> Alternatives:
        """Some of them."""
        return Alternatives(self.poses[rows], self.scores[rows])

    def and_(self, other: Alternatives) -> Alternatives:
        """These and others."""
        return Alternatives(
            torch.cat((self.poses, other.poses)), torch.cat((self.scores, other.scores))
        )


def scored(states: Tensor, frame: DetectedFrame) -> Alternatives:
    """Hands (N, 27) with what they are compared by: the image, the votes, room for the fingers."""
    scores = frame.log_scores(states)
    # What speaks against a pose never raises its score: it matters for the first few only.
    rows = torch.arange(len(states), device=states.device)
    if len(states) > _CLOSE:
        rows = torch.cat((rows[:1], scores[1:].topk(_CLOSE - 1).indices + 1))
    word = torch.full_like(scores, -torch.inf)
    word[rows] = joints_log_prior(frame.hand.refiner.joints(states[rows]), frame)
    return Alternatives(states, scores + word)


def with_other_fingers(
    found: Alternatives,
    poses: Tensor,
    frame: DetectedFrame,
    cfg: Refinement,
    generator: torch.Generator,
) -> Tensor:
    """(N, 27) the best of the found pose (1, 27) with single fingers of other poses, N few.

    poses: (M, 21) likely ones, every finger of which is tried; of natural poses a few are.
    """
    tried = (
        swap_fingers(found.poses, frame.model.poses, cfg.swaps, generator)[1:],
        exchange_fingers(found.poses, poses),
    )
    swapped = scored(torch.cat(tried), frame)
    best = swapped.scores.topk(min(_SWAPPED, len(swapped.scores)))
    return swapped.poses[best.indices[best.values > found.scores]]


def select(
    found: Alternatives, others: Alternatives, track: Track, dt_s: float, frame: DetectedFrame
) -> tuple[Tensor, Contender | None]:
    """The pose (1, 27) of a frame and its contender, from the found pose and others beside it.

    Much the same poses are better or worse; other ones must prove themselves.
    """
    if not len(others.scores):
        return found.poses, None
    refiner, old = frame.hand.refiner, track.contender
    joints = refiner.joints(torch.cat((found.poses, others.poses)))
    other = _apart(joints[1:], joints[:1])
    same = others.scores.masked_fill(other, -torch.inf)
    if same.max() > found.scores:
        found = others.rows(same.argmax()[None])
    if not bool(other.any()):
        return found.poses, None
    lead = (others.scores - found.scores) * _weight(dt_s) - frame.model.refinement.drift
    if track.age_s == 0:
        lead = lead + torch.inf
    elif old is not None:
        lead = lead + old.lead * ~_apart(joints[1:], refiner.joints(old.pose))
    lead = lead.masked_fill(~other, -torch.inf)
    best = int(lead.argmax())
    if others.scores[best] > found.scores and lead[best] > _needed(track, frame):
        return others.poses[best][None], None
    lead_so_far = float(lead[best])
    return found.poses, Contender(
        others.poses[best][None], lead_so_far
    ) if lead_so_far > 0 else None


def _weight(dt_s: float) -> float:
    """Of a frame's word: after a pause it speaks for the frames that were dropped, too."""
    return dt_s / FRAME_S if dt_s < FRAME_S or dt_s > _PAUSE_S else 1.0


def _apart(joints_m: Tensor, from_m: Tensor) -> Tensor:
    """(N,) whether hands (N, 21, 3) have a joint that is far from another hand's (1, 21, 3)."""
    return (joints_m - from_m).norm(dim=-1).amax(1) > _OTHER_M


def _needed(track: Track, frame: DetectedFrame) -> float:
    """The lead with which a contender takes over: little where the track is not believed."""
    gain = frame.model.refinement.swap_gain
    if track.log_odds is None:
        return gain
    believed = 1 / (1 + math.exp(-min(max(track.log_odds, -30.0), 30.0)))
    return gain * min(1.0, max(_LEAST_CREDIT, 2 * believed))


def rivals_of(
    found: Alternatives, others: Alternatives, frame: DetectedFrame
) -> tuple[Alternatives, Tensor | None]:
    """Those of the networks' poses that are about the found one, and the best that is not.

    The latter, (1, 27), is another hand or another way round; None where none is better.
    """
    detector = frame.model.detector
    states = torch.cat((found.poses, others.poses))
    joints = frame.hand.refiner.joints(states)
    near = (joints[1:] - joints[:1]).norm(dim=-1).mean(1) < detector.settings.rival_m
    rival = None
    if bool((~near).any()):
        scores = log_posterior(states, joints, frame)
        scores[1:][near] = -torch.inf
        best = int(scores[1:].argmax())
        if scores[1 + best] > scores[0] + detector.settings.rival_gain:
            rival = others.poses[best][None]
    return others.rows(near.nonzero()[:, 0]), rival
