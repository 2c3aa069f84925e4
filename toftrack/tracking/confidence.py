"""How likely an estimate is right: a calibrated probability from everything that bears on it.

A logistic model of a few signs, fitted by toftrack.programs.fit_confidence on rendered sequences of
other hands, persons and sensors than any recording that the tracker is judged on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from toftrack.checks import check_number
from toftrack.compute.pace import FRAME_S
from toftrack.errors import ToftrackError
from toftrack.tracking.features import FEATURES, ConfidenceFeatures
from toftrack.tracking.joint_confidence import JointConfidence
from toftrack.tracking.life_cycle import Status, bad_for, reached
from toftrack.tracking.state import Track

_HIDDEN = 0.3
"""Share of the joints behind something from which on a hand is hidden."""
_WAITED = 10
"""Times as long is waited for a hidden hand."""


@dataclass(frozen=True)
class ConfidenceModel:
    """When an estimate is not to be used, and when its track is given up; see conf/lost.

    confidence: estimates that are right with a lower probability are flagged lost.
    believe: likewise, until a track was believed for the first time.  second: or while another hand
        is believed.
    give_up: below this, a frame is bad.  patience: bad frames in a row until a new search.
    memory: part of the log odds that comes from the frames before.
    probation: frames after a start during which the hand is not remembered as seen.
    intercept, weights: of the signs, by name.
    joints: what is thought of each joint.
    """

    confidence: float
    believe: float
    second: float
    give_up: float
    patience: int
    memory: float
    probation: int
    intercept: float
    weights: Mapping[str, float]
    joints: JointConfidence

    def __post_init__(self) -> None:
        for name in ("confidence", "believe", "second", "give_up"):
            check_number(f"lost.{name}", getattr(self, name), 0, 1)
        check_number("lost.memory", self.memory, 0, 0.99)
        for name in ("patience", "probation"):
            check_number(f"lost.{name}", getattr(self, name), 0, whole=True)
        check_number("lost.intercept", self.intercept)
        for name, value in self.weights.items():
            if name not in FEATURES:
                raise ToftrackError(
                    f"lost.weights.{name} is unknown; the signs are {', '.join(FEATURES)}"
                )
            check_number(f"lost.weights.{name}", value)

    def log_odds(self, features: ConfidenceFeatures) -> float:
        """That every joint is within 40 mm, from one frame."""
        return self.intercept + sum(w * getattr(features, name) for name, w in self._weights)

    @cached_property
    def _weights(self) -> list[tuple[str, float]]:
        # A mapping out of a configuration takes microseconds for each of its items.
        return [(name, float(weight)) for name, weight in self.weights.items()]

    def judge(
        self,
        track: Track,
        features: ConfidenceFeatures,
        dt_s: float,
        side: float = 1.0,
        second: bool = False,
    ) -> Status:
        """What is thought of an estimate, dt_s after the last, and whether its track goes on.

        side: probability that it is of the right side; of the other one every finger is wrong.
        second: another hand is believed already.
        """
        now = self.log_odds(features)
        before = track.log_odds
        kept = self.memory ** (dt_s / FRAME_S)
        smooth = now if before is None else kept * before + (1 - kept) * now
        confidence = 1 / (1 + math.exp(-min(max(smooth, -30.0), 30.0)))
        bad = bad_for(track.bad_s, dt_s) if confidence < self.give_up else 0.0
        # What is hidden is waited for.
        patience = self.patience * (_WAITED if features.hidden > _HIDDEN else 1)
        ends = patience > 0 and bad > 0 and reached(bad, patience)
        # Whether it is a hand at all does not depend on whose it is.
        new = 0.0 if track.believed else self.second if second else self.believe
        lost = confidence < new or side * confidence < self.confidence
        confidence *= side
        return Status(not ends, _state_name(features, lost), lost, bad, confidence, smooth)


def _state_name(features: ConfidenceFeatures, lost: bool) -> str:
    """Why an estimate is not to be used."""
    if not lost:
        return "tracking"
    if features.unseen > 0.4:
        return "out of view"
    return "hidden" if features.hidden > _HIDDEN else "searching"
