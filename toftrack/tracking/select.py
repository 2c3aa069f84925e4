"""Selection of a frame's pose: the hypothesis with the highest posterior, but for two margins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from torch import Tensor

_MARGIN = 0.05
"""What a pose of the detector loses in log posterior against the other sources: neighbouring
fingers change places from frame to frame otherwise (swaps +0.6 points)."""
_SURE_LEAD = 2.0
"""The same of a pose elsewhere while something hides the hand: without it, a second hand that
crosses the first one is silently wrong in 5 % of the frames."""
_ELSEWHERE_M = 0.02
"""A pose of the detector is elsewhere when its joints are so far from the others', on average."""
WORST = -1e6
"""Instead of the -inf of a pose that explains nothing, so that differences stay numbers."""


class Source(IntEnum):
    """Where a hypothesis comes from."""

    PREVIOUS = 0
    """The last frame's fingers at the filter's wrist; of a covered hand, its last pose."""
    DYNAMICS = 1
    """The filter's estimate."""
    DETECTOR = 2
    """The detector's likeliest hypothesis, raw or bent to the keypoints."""


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """A table of poses of one hand, a row each.

    pose: (N, 27).  joints_m: (N, 21, 3).  source: of each.  log_posterior: (N,).
    """

    pose: Tensor
    joints_m: Tensor
    source: Sequence[Source]
    log_posterior: Tensor

    def __len__(self) -> int:
        return len(self.pose)


@dataclass(frozen=True, eq=False)
class Choice:
    """The chosen pose of a frame.

    pose: (1, 27).  moved: the detector sees it elsewhere: the track is to restart there.
    """

    pose: Tensor
    moved: bool


def select(table: Hypotheses, hidden: bool) -> Choice:
    """The best of a hand's scored hypotheses; one of the detector must be better by a margin.

    table: with at least one row that is not the detector's.
    hidden: something hides part of the hand. Then a pose elsewhere needs a large lead, for it may
        be of what hides the hand, such as another hand.
    """
    # In numpy: on a few rows each of torch's operations takes longer than its arithmetic.
    joints, source = table.joints_m.numpy(), np.array(table.source)
    values = np.maximum(table.log_posterior.numpy(), WORST)
    detectors = source == Source.DETECTOR
    base = int(np.where(detectors, -np.inf, values).argmax())
    away = np.sqrt(np.square(joints - joints[base]).sum(-1)).mean(1)
    elsewhere = detectors & (away >= _ELSEWHERE_M)
    values = values - np.where(elsewhere & hidden, _SURE_LEAD, _MARGIN * detectors)
    best = int(values.argmax())
    return Choice(table.pose[best][None], bool(elsewhere[best]))
