"""What is thought of an estimate, and how long something has gone on."""

from __future__ import annotations

import math
from dataclasses import dataclass

from toftrack.compute.pace import FRAME_S


@dataclass(frozen=True)
class Status:
    """What is thought of a frame's estimate.

    kept: the track goes on.  state_name, lost: as Estimate has them.
    bad_s: as Track has it, with this frame.
    confidence: probability that every joint is within 40 mm; NaN where nobody says.
    log_odds: the same, smoothed over time.
    """

    kept: bool
    state_name: str
    lost: bool
    bad_s: float = 0.0
    confidence: float = math.nan
    log_odds: float = math.nan


def log_odds(probability: float) -> float:
    """Of a probability in 0 .. 1, both excluded."""
    return math.log(probability / (1 - probability))


def reached(seconds: float, frames: float) -> bool:
    """Whether something has gone on for so many frames of FRAME_S; half a frame is forgiven."""
    return seconds > (frames - 0.5) * FRAME_S


def extended(seconds: float, dt_s: float) -> float:
    """What has gone on for so long, a frame later; where it begins, that frame is FRAME_S."""
    return seconds + dt_s if seconds else FRAME_S


def bad_for(seconds: float, dt_s: float) -> float:
    """As `longer`, of what is to end a track: what was dropped between two frames was not bad, so
    that a frame counts twice FRAME_S at most.
    """
    return extended(seconds, min(dt_s, 2 * FRAME_S))
