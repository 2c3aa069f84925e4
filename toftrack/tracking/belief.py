"""Status of an estimate and its track: the confidence, and whether it is lost."""

from __future__ import annotations

import math
from dataclasses import dataclass

from toftrack.compute.pace import FRAME_S, Duration
from toftrack.tracking.confidence import ConfidenceFeatures, ConfidenceModel
from toftrack.tracking.state import Track

_HIDDEN = 0.3
"""A hand is hidden where more than this share of its joints is behind something."""
_OUT_OF_VIEW = 0.4
"""A hand is out of view where more than this share of its joints is outside of the image."""


@dataclass(frozen=True)
class Status:
    """What is thought of a frame's estimate.

    state_name, lost: as Estimate has them.
    confidence: probability that every joint is within 40 mm; NaN where nothing says.
    log_odds: the same, smoothed over time.  whole_odds: likewise of the mean joint error.
    doubtful: as Track has it, with this frame.
    """

    state_name: str
    lost: bool
    confidence: float = math.nan
    log_odds: float = 0.0
    whole_odds: float = 0.0
    doubtful: Duration = Duration()


def judge(
    track: Track, features: ConfidenceFeatures, dt_s: float, model: ConfidenceModel
) -> Status:
    """The status of a track's estimate, dt_s after its last one."""
    kept = model.memory ** (dt_s / FRAME_S) if track.age.begun else 0.0
    smooth = kept * track.log_odds + (1 - kept) * model.log_odds(features)
    whole = kept * track.whole_odds + (1 - kept) * model.whole_odds(features)
    confidence, probable = probability(smooth), probability(whole)
    # What was dropped between two frames was not doubtful: a frame counts twice FRAME_S at most.
    passed = min(dt_s, 2 * FRAME_S) if track.doubtful.begun else FRAME_S
    doubtful = Duration(track.doubtful.seconds + passed)
    doubtful = doubtful if confidence < model.give_up else Duration()
    confirmed = track.confirmed or confidence >= model.believe
    lost = not confirmed or confidence < model.confidence or probable < model.whole
    name = _state_name(features) if lost else "tracking"
    return Status(name, lost, confidence, smooth, whole, doubtful)


def probability(log_odds: float) -> float:
    """The probability of log odds, which count up to 30 either way."""
    return 1 / (1 + math.exp(-min(max(log_odds, -30.0), 30.0)))


def _state_name(features: ConfidenceFeatures) -> str:
    """The state name of a lost estimate."""
    if features.unseen > _OUT_OF_VIEW:
        return "out of view"
    return "hidden" if features.hidden > _HIDDEN else "searching"
