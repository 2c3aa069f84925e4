"""Which of a frame's hypotheses is the hand: the one with the highest posterior.

A hypothesis of the detector at another place, or the other way round, must be better in several
frames without a break.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.pace import Duration

_WORST = -1e6
"""Instead of the -inf of a pose that explains nothing, so that differences stay numbers."""
_SURE_LEAD = 2.0
"""Of the log posterior, with which a hypothesis of the detector at another place takes over even
while something hides the hand; as others do, in several frames without a break."""


class Source(IntEnum):
    """Where a hypothesis comes from."""

    HELD = 0
    """The last frame's pose as it was, while the hand is hidden."""
    PREVIOUS = 1
    """The last frame's fingers where the filter has the hand."""
    DYNAMICS = 2
    """The filter's estimate."""
    DETECTOR = 3
    """The detector's likeliest hypothesis, as it is and bent to its keypoints."""


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """A table of poses of one hand, a row each.

    pose: (N, 27).  source: (N,) see Source.  log_posterior: (N,), NaN before they are scored.
    """

    pose: Tensor
    source: Tensor
    log_posterior: Tensor

    @classmethod
    def of(cls, pose: Tensor, source: Source) -> Hypotheses:
        """Poses (N, 27) of one source, not scored."""
        n = len(pose)
        return cls(pose, torch.full((n,), int(source)), torch.full((n,), math.nan))

    @classmethod
    def joined(cls, tables: Sequence[Hypotheses]) -> Hypotheses:
        """One below the other."""
        if len(tables) == 1:
            return tables[0]
        return cls(
            torch.cat([table.pose for table in tables]),
            torch.cat([table.source for table in tables]),
            torch.cat([table.log_posterior for table in tables]),
        )

    def __len__(self) -> int:
        return len(self.pose)


@dataclass(frozen=True)
class Hysteresis:
    """When a pose of the detector takes over.

    margin: by so much its log posterior must be better than that of the last frame's fingers, or
        neighbouring fingers change places from frame to frame (on fresh draws swaps -0.6 points).
    place_m, place_lead, place_frames: one that is, on average over the joints, at least so many
        metres away must be better by so much in so many frames without a break.
    """

    margin: float = 0.02
    place_m: float = 0.02
    place_lead: float = 0.03
    place_frames: int = 3


@dataclass(frozen=True, eq=False)
class Incumbent:
    """What a track brings to the choice of its frame's pose.

    challenged: how long a pose of another place has been better.
    new: this is the track's first frame.
    emerges: it was hidden and lost, and the detector surely sees it.
    """

    challenged: Duration
    new: bool
    emerges: bool = False


@dataclass(frozen=True, eq=False)
class Choice:
    """The pose of a frame, and what the choice of the next one begins with.

    pose: (1, 27).  moved: it is of another place, where a new track begins.
    challenged: see Track.
    """

    pose: Tensor
    moved: bool
    challenged: Duration


def select(
    table: Hypotheses,
    joints_m: Tensor,
    incumbent: Incumbent,
    dt_s: float,
    detected: bool,
    hidden: bool,
    settings: Hysteresis = Hysteresis(),
) -> Choice:
    """The pose of one hand in a frame.

    The best of all hypotheses, those of the detector with a margin, but for its hypotheses at
    another place than the best of the filter's: such a one takes over when it was better by
    `place_lead` in `place_frames` frames, or at once where a hand emerges; while something hides
    the hand, only with a large lead.

    table: the hand's hypotheses, scored.  joints_m: (N, 21, 3) of them.
    dt_s: since the last frame.  detected: the detector was asked in this frame.
    """
    # In numpy: on a few rows each of torch's operations takes longer than its arithmetic.
    joints, source = joints_m.numpy(), table.source.numpy()
    values = np.maximum(table.log_posterior.numpy(), _WORST)
    base = _best_of(values, source <= Source.DYNAMICS)
    score = values - values[base]
    detectors = source == Source.DETECTOR
    away = np.sqrt(np.square(joints - joints[base]).sum(-1)).mean(1)
    elsewhere = detectors & (away >= settings.place_m)
    best, challenged = _best_of(score, elsewhere), incumbent.challenged
    if detected:
        lead = float(score[best]) if best >= 0 else -math.inf
        surely = lead > _SURE_LEAD
        leads = lead > settings.place_lead and (surely or not hidden)
        challenged = challenged.extended(dt_s) if leads else Duration()
        at_once = incumbent.new or incumbent.emerges
        if leads and (at_once or challenged.reached(settings.place_frames)):
            return Choice(table.pose[best][None], True, Duration())
    best = _best_of(score - settings.margin * detectors, ~elsewhere)
    return Choice(table.pose[best][None], False, challenged)


def _best_of(values: np.ndarray, mask: np.ndarray) -> int:
    """The row of the largest value under a mask; -1 where the mask has none."""
    return int(np.where(mask, values, -np.inf).argmax()) if mask.any() else -1
