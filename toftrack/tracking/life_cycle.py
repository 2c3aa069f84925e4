"""When a hand is believed, doubted and given up."""

from __future__ import annotations

import math
from dataclasses import dataclass

from toftrack.checks import check_number
from toftrack.tracking.state import Track


@dataclass(frozen=True)
class LostSettings:
    """When the tracker says that it has lost the hand; see conf/lost for what each does."""

    score: float
    patience: int
    start_score: float
    probation: int
    rival_gain: float
    outside_rad: float

    def __post_init__(self) -> None:
        for name in ("patience", "probation"):
            check_number(f"lost.{name}", getattr(self, name), 0, whole=True)
        for name in ("score", "start_score"):
            check_number(f"lost.{name}", getattr(self, name), 0, 1)
        check_number("lost.rival_gain", self.rival_gain, 0)
        if self.outside_rad != math.inf:
            check_number("lost.outside_rad", self.outside_rad, 0, remedy=", or .inf")


@dataclass(frozen=True)
class Belief:
    """What is thought of a frame's estimate.

    kept: the track goes on.  state_name, lost: as Estimate has them.
    bad: frames in a row with a low score.  outside: frames in a row out of the pose space.
    """

    kept: bool
    state_name: str
    lost: bool
    bad: int
    outside: int


def believe(track: Track, score: float, off_rad: float, settings: LostSettings) -> Belief:
    """Whether to believe an estimate, and whether to go on with its track.

    track: as of the frame before.  score: of the estimate, 0..1.
    off_rad: how far its pose lies off the pose space, rms.
    """
    bad = track.bad + 1 if score < settings.score else 0
    outside = track.outside + 1 if off_rad > settings.outside_rad else 0
    if track.age == 0 and score < settings.start_score:
        return Belief(False, "initialising", True, bad, outside)
    if settings.patience and bad >= settings.patience:
        return Belief(False, "lost", True, bad, outside)
    if bad >= 2 or (bad and not settings.patience):
        return Belief(True, "recovering", True, bad, outside)
    name = "initialising" if track.age == 0 else "tracking"
    return Belief(True, name, outside >= 2, bad, outside)
