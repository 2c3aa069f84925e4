"""When a hand is believed, doubted and given up."""

from __future__ import annotations

import math
from dataclasses import dataclass

from toftrack.checks import check_number
from toftrack.compute.pace import FRAME_S
from toftrack.tracking.state import Track


@dataclass(frozen=True)
class LostSettings:
    """When the tracker says that it has lost the hand; see conf/lost for what each does.

    patience, probation: in frames of FRAME_S.
    """

    score: float
    patience: float
    start_score: float
    probation: float
    rival_gain: float
    outside_rad: float

    def __post_init__(self) -> None:
        for name in ("patience", "probation"):
            check_number(f"lost.{name}", getattr(self, name), 0)
        for name in ("score", "start_score"):
            check_number(f"lost.{name}", getattr(self, name), 0, 1)
        check_number("lost.rival_gain", self.rival_gain, 0)
        if self.outside_rad != math.inf:
            check_number("lost.outside_rad", self.outside_rad, 0, remedy=", or .inf")


@dataclass(frozen=True)
class Belief:
    """What is thought of a frame's estimate.

    kept: the track goes on.  state_name, lost: as Estimate has them.
    bad_s, outside_s: as Track has them, with this frame.
    confidence: probability that every joint is within 40 mm; NaN where nobody says.
    log_odds: the same, smoothed over time; None likewise.
    """

    kept: bool
    state_name: str
    lost: bool
    bad_s: float
    outside_s: float
    confidence: float = math.nan
    log_odds: float | None = None


def log_odds(probability: float) -> float:
    """Of a probability in 0 .. 1, both excluded."""
    return math.log(probability / (1 - probability))


def lasted(seconds: float, frames: float) -> bool:
    """Whether something has gone on for so many frames of FRAME_S; half a frame is forgiven."""
    return seconds > (frames - 0.5) * FRAME_S


def longer(seconds: float, dt_s: float) -> float:
    """What has gone on for so long, a frame later; where it begins, that frame is FRAME_S."""
    return seconds + dt_s if seconds else FRAME_S


def bad_for(seconds: float, dt_s: float) -> float:
    """As `longer`, of what is to end a track: what was dropped between two frames was not bad, so
    that a frame counts twice FRAME_S at most.
    """
    return longer(seconds, min(dt_s, 2 * FRAME_S))


def believe(
    track: Track, score: float, off_rad: float, dt_s: float, settings: LostSettings
) -> Belief:
    """Whether to believe an estimate, and whether to go on with its track.

    track: as of the frame before.  score: of the estimate, 0..1.
    off_rad: how far its pose lies off the pose space, rms.  dt_s: since the last frame.
    """
    bad = bad_for(track.bad_s, dt_s) if score < settings.score else 0.0
    outside = longer(track.outside_s, dt_s) if off_rad > settings.outside_rad else 0.0
    if track.age_s == 0 and score < settings.start_score:
        return Belief(False, "initialising", True, bad, outside)
    if bad and settings.patience and lasted(bad, settings.patience):
        return Belief(False, "lost", True, bad, outside)
    if bad and (lasted(bad, 2) or not settings.patience):
        return Belief(True, "recovering", True, bad, outside)
    name = "initialising" if track.age_s == 0 else "tracking"
    return Belief(True, name, lasted(outside, 2), bad, outside)
