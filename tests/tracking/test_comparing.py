"""When both sides of a hand are compared."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest

from toftrack.tracking.comparing import comparison_due
from toftrack.tracking.handedness import HandednessEstimate, HandednessSettings
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.state import HandState

SETTINGS = HandednessSettings()


def due(given: bool, believed: bool, log_odds: float) -> bool:
    """Of a hand that was compared nine seconds ago."""
    track = SimpleNamespace(believed=believed, log_odds=log_odds)
    handedness = HandednessEstimate(given=given, age_s=9.0)
    hand = cast(HandState, SimpleNamespace(track=track, handedness=handedness))
    model = SimpleNamespace(configured=SimpleNamespace(handedness=SETTINGS))
    return comparison_due(hand, cast(TrackerModel, model), 0.04)


def test_an_estimate_that_is_probably_wrong_says_nothing_of_a_given_side() -> None:
    assert not due(given=True, believed=True, log_odds=-2.0)


@pytest.mark.parametrize(
    ("given", "believed", "log_odds"), [(True, True, 0.0), (True, False, -2.0), (False, True, -2.0)]
)
def test_others_are_compared(given: bool, believed: bool, log_odds: float) -> None:
    assert due(given, believed, log_odds)
