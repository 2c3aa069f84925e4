"""Which of a frame's hypotheses is the hand, with all hysteresis that there is.

What is a little better changes from frame to frame, and one image often says as much for a pose as
for the same with the neighbouring finger. So a pose with other fingers must prove itself: its lead
is summed up over frames, as in a sequential test (Page, "Continuous inspection schemes", Biometrika
41, 1954), and it takes over when the lead is large enough. A hypothesis of the detector at another
place, or the other way round, must be better in several frames without a break.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import torch
from torch import Tensor

from toftrack.checks import check_number
from toftrack.compute.pace import FRAME_S, Duration

_OTHER_M = 0.025
"""Poses with a joint that is farther off are other ones."""
_PAUSE_S = 0.06
"""A time between two frames that is not the usual one."""
_WORST = -1e6
"""Instead of the -inf of a pose that explains nothing, so that differences stay numbers."""
_SURE_LEAD = 2.0
"""Of the log posterior, with which a hypothesis of the detector at another place takes over even
while something hides the hand; as others do, in several frames without a break."""
_LEAST_CREDIT = 0.2
"""Of the lead that is needed against a pose that is surely right, so much is needed against any."""


class Source(IntEnum):
    """Where a hypothesis comes from."""

    HELD = 0
    """The last frame's pose as it was, while the hand is hidden."""
    PREVIOUS = 1
    """The last frame's fingers where the filter has the hand."""
    DYNAMICS = 2
    """The filter's estimate."""
    CONTENDER = 3
    """The pose that has been better for a while."""
    DETECTOR = 4
    """The detector's hypotheses, as they are and bent to its keypoints."""
    EXCHANGED = 5
    """The best pose with a single finger of another one."""


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

    def rows(self, rows: Tensor | slice) -> Hypotheses:
        """Some rows, by number, as a mask or a slice."""
        return Hypotheses(self.pose[rows], self.source[rows], self.log_posterior[rows])

    def of_source(self, *sources: Source) -> Hypotheses:
        """The rows of some sources."""
        return self.rows(torch.stack([self.source == int(source) for source in sources]).any(0))

    @property
    def best(self) -> Hypotheses:
        """The row with the highest posterior, the first of equals."""
        row = int(self.log_posterior.argmax())
        return self.rows(slice(row, row + 1))

    def __len__(self) -> int:
        return len(self.pose)


@dataclass(frozen=True)
class Hysteresis:
    """When another pose takes over; see conf/hysteresis for what each does."""

    exchanged: int
    lead: float
    drift: float
    alternate: float
    place_m: float
    place_lead: float
    place_frames: int

    def __post_init__(self) -> None:
        for name in ("exchanged", "place_frames"):
            least = 1 if name == "place_frames" else 0
            check_number(f"hysteresis.{name}", getattr(self, name), least, whole=True)
        for name in ("lead", "drift", "place_lead"):
            check_number(f"hysteresis.{name}", getattr(self, name), 0)
        check_number("hysteresis.place_m", self.place_m, 0, above=True)
        check_number("hysteresis.alternate", self.alternate, 0.5, 1)


@dataclass(frozen=True, eq=False)
class Incumbent:
    """What a track brings to the choice of its frame's pose.

    contender_m: (C, 21, 3) joints of its contender, C = 0 or 1.  lead: of the contender.
    challenged: how long a pose of another place has been better.
    log_odds: that the last estimate was right.  new: this is the track's first frame.
    emerges: it was hidden and lost, and the detector surely sees it.
    """

    contender_m: Tensor
    lead: float
    challenged: Duration
    log_odds: float
    new: bool
    emerges: bool = False


@dataclass(frozen=True, eq=False)
class Choice:
    """The pose of a frame, and what the choice of the next one begins with.

    pose: (1, 27).  moved: it is of another place, where a new track begins.
    contender: (C, 27), C = 0 or 1.  lead, challenged: see Track.
    """

    pose: Tensor
    moved: bool
    contender: Tensor
    lead: float
    challenged: Duration


def select(
    table: Hypotheses,
    joints_m: Tensor,
    incumbent: Incumbent,
    dt_s: float,
    detected: bool,
    hidden: bool,
    settings: Hysteresis,
) -> Choice:
    """The pose of one hand in a frame.

    1. The last frame's fingers stand unless the filter's are better.
    2. A hypothesis of the detector at another place takes over when it was better by `place_lead`
       in `place_frames` frames, or at once where a hand emerges; while something hides the hand,
       only with a large lead.
    3. Of all others, one that is much the same takes over when it is better;
    4. one with other fingers takes over when its lead, summed up over frames, is large enough.

    table: the hand's hypotheses, scored.  joints_m: (N, 21, 3) of them.
    dt_s: since the last frame.  detected: the detector was asked in this frame.
    """
    # In numpy: on a few rows each of torch's operations takes longer than its arithmetic.
    joints, source = joints_m.numpy(), table.source.numpy()
    values = np.maximum(table.log_posterior.numpy(), _WORST)
    stands = source <= Source.DYNAMICS
    base = _best_of(values, stands)
    score = values - values[base]
    elsewhere = _distances(joints, joints[base]).mean(1) >= settings.place_m
    elsewhere &= source == Source.DETECTOR
    best, challenged = _best_of(score, elsewhere), incumbent.challenged
    if detected:
        lead = float(score[best]) if best >= 0 else -math.inf
        surely = lead > _SURE_LEAD
        leads = lead > settings.place_lead and (surely or not hidden)
        challenged = challenged.extended(dt_s) if leads else Duration()
        at_once = incumbent.new or incumbent.emerges
        if leads and (at_once or challenged.reached(settings.place_frames)):
            return Choice(table.pose[best][None], True, table.pose[:0], 0.0, Duration())
    others = ~elsewhere & ~stands
    far = others & _apart(joints, joints[base])
    same = _best_of(score, others & ~far)
    if same >= 0 and float(score[same]) > 0:
        base, score = same, score - score[same]
    contender, lead = _contender(score, far, joints, incumbent, dt_s, settings)
    if contender >= 0 and float(score[contender]) > 0 and lead > _needed(incumbent, settings):
        return Choice(table.pose[contender][None], False, table.pose[:0], 0.0, challenged)
    kept = table.pose[contender][None] if contender >= 0 and lead > 0 else table.pose[:0]
    return Choice(table.pose[base][None], False, kept, max(lead, 0.0), challenged)


def _contender(
    score: np.ndarray,
    far: np.ndarray,
    joints_m: np.ndarray,
    incumbent: Incumbent,
    dt_s: float,
    settings: Hysteresis,
) -> tuple[int, float]:
    """The row of the other pose with the largest lead, and the lead; -1 where there is none.

    score: (N,) in units of the standing pose's.  far: (N,) bool, the other poses.
    """
    if not far.any():
        return -1, 0.0
    # After a pause a frame speaks for those that were dropped, too.
    weight = dt_s / FRAME_S if dt_s < FRAME_S or dt_s > _PAUSE_S else 1.0
    lead = score * weight - settings.drift
    if len(incumbent.contender_m):
        lead = lead + incumbent.lead * ~_apart(joints_m, incumbent.contender_m[0].numpy())
    row = _best_of(lead, far)
    return row, float(lead[row])


def _best_of(values: np.ndarray, mask: np.ndarray) -> int:
    """The row of the largest value under a mask; -1 where the mask has none."""
    return int(np.where(mask, values, -np.inf).argmax()) if mask.any() else -1


def _distances(joints_m: np.ndarray, from_m: np.ndarray) -> np.ndarray:
    """(N, 21) how far the joints of hands (N, 21, 3) are from another hand's (21, 3)."""
    away: np.ndarray = np.sqrt(np.square(joints_m - from_m).sum(-1))
    return away


def _apart(joints_m: np.ndarray, from_m: np.ndarray) -> np.ndarray:
    """(N,) whether hands (N, 21, 3) have a joint that is far from another hand's (21, 3)."""
    apart: np.ndarray = _distances(joints_m, from_m).max(1) > _OTHER_M
    return apart


def _needed(incumbent: Incumbent, settings: Hysteresis) -> float:
    """The lead with which a contender takes over: little where the estimate is doubtful, and any in
    a track's first frame.
    """
    if incumbent.new:
        return -math.inf
    probability = 1 / (1 + math.exp(-min(max(incumbent.log_odds, -30.0), 30.0)))
    return settings.lead * min(1.0, max(_LEAST_CREDIT, 2 * probability))
