"""How likely an estimate is right: a calibrated probability from everything that bears on it.

A logistic model of a few signs, fitted by toftrack.programs.fit_belief on rendered sequences of
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
from toftrack.tracking.joint_belief import JointBelief
from toftrack.tracking.life_cycle import Belief, bad_for, lasted
from toftrack.tracking.signs import SIGNS, Signs
from toftrack.tracking.state import Track

_HIDDEN = 0.3
"""Share of the joints behind something from which on a hand is hidden."""
_WAITED = 10
"""Times as long is waited for a hidden hand."""


@dataclass(frozen=True)
class CalibratedBelief:
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
    joints: JointBelief

    def __post_init__(self) -> None:
        for name in ("confidence", "believe", "second", "give_up"):
            check_number(f"lost.{name}", getattr(self, name), 0, 1)
        check_number("lost.memory", self.memory, 0, 0.99)
        for name in ("patience", "probation"):
            check_number(f"lost.{name}", getattr(self, name), 0, whole=True)
        check_number("lost.intercept", self.intercept)
        for name, value in self.weights.items():
            if name not in SIGNS:
                raise ToftrackError(
                    f"lost.weights.{name} is unknown; the signs are {', '.join(SIGNS)}"
                )
            check_number(f"lost.weights.{name}", value)

    def log_odds(self, signs: Signs) -> float:
        """That every joint is within 40 mm, from one frame."""
        return self.intercept + sum(w * getattr(signs, name) for name, w in self._weights)

    @cached_property
    def _weights(self) -> list[tuple[str, float]]:
        # A mapping out of a configuration takes microseconds for each of its items.
        return [(name, float(weight)) for name, weight in self.weights.items()]

    def judge(
        self, track: Track, signs: Signs, dt_s: float, side: float = 1.0, second: bool = False
    ) -> Belief:
        """What is thought of an estimate, dt_s after the last, and whether its track goes on.

        side: probability that it is of the right side; of the other one every finger is wrong.
        second: another hand is believed already.
        """
        now = self.log_odds(signs)
        before = track.log_odds
        kept = self.memory ** (dt_s / FRAME_S)
        smooth = now if before is None else kept * before + (1 - kept) * now
        confidence = 1 / (1 + math.exp(-min(max(smooth, -30.0), 30.0)))
        bad = bad_for(track.bad_s, dt_s) if confidence < self.give_up else 0.0
        # What is hidden is waited for.
        patience = self.patience * (_WAITED if signs.hidden > _HIDDEN else 1)
        ends = patience > 0 and bad > 0 and lasted(bad, patience)
        # Whether it is a hand at all does not depend on whose it is.
        new = 0.0 if track.believed else self.second if second else self.believe
        lost = confidence < new or side * confidence < self.confidence
        confidence *= side
        return Belief(not ends, _state_name(signs, lost), lost, bad, confidence, smooth)


def _state_name(signs: Signs, lost: bool) -> str:
    """Why an estimate is not to be used."""
    if not lost:
        return "tracking"
    if signs.unseen > 0.4:
        return "out of view"
    return "hidden" if signs.hidden > _HIDDEN else "searching"
