"""What is thought of an estimate, and how long a track is kept that nobody is sure of."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from helpers.configured import confidence_model
from helpers.rendered import hand_at, track_of

from toftrack.compute.pace import FRAME_S, Duration
from toftrack.tracking.association import track_ends
from toftrack.tracking.confidence import Status, judge, probability
from toftrack.tracking.confidence import NO_FEATURES, ConfidenceModel, LogOdds
from toftrack.tracking.state import Track

pytestmark = pytest.mark.usefixtures("one_thread")

NEW = 0.6
PLAIN = replace(
    confidence_model(memory=0.0, believe=NEW, confidence=0.3, give_up=0.1, whole=0.0),
    log_odds=LogOdds(0.0, {"log_score": 1.0}),
    whole_odds=LogOdds(0.0, {}),
)
"""Log odds are just the feature log_score."""


def followed(**changes: object) -> Track:
    return track_of(hand_at(), **changes)


def judged(
    track: Track,
    chance: float,
    dt_s: float = FRAME_S,
    model: ConfidenceModel = PLAIN,
    **features: float,
) -> Status:
    log_odds = math.log(chance / (1 - chance))
    return judge(track, replace(NO_FEATURES, log_score=log_odds, **features), dt_s, model)


def frames_until_end(patience: int, dt_s: float = FRAME_S) -> int | None:
    """After so many doubtful frames a track ends; None = it does not."""
    track = followed()
    for number in range(1, 500):
        track = replace(track, doubtful=judged(track, 0.05, dt_s).doubtful)
        if track_ends(track, False, patience):
            return number
    return None


@pytest.mark.parametrize(("patience", "frames"), [(1, 1), (5, 5), (8, 8), (0, None)])
def test_a_doubtful_track_ends_after_its_patience(patience: int, frames: int | None) -> None:
    assert frames_until_end(patience) == frames


def test_patience_is_a_time_but_what_was_dropped_was_not_doubtful() -> None:
    assert frames_until_end(5, dt_s=FRAME_S / 2) == 9, "1 + 8 halves"
    assert frames_until_end(5, dt_s=0.5) == 3, "1 + 2 + 2"


def test_a_frame_that_is_not_doubtful_begins_the_patience_anew() -> None:
    track = followed()
    for chance in [0.05] * 4 + [0.2] + [0.05] * 4:
        track = replace(track, doubtful=judged(track, chance).doubtful)
        assert not track_ends(track, False, 5)
    assert track_ends(replace(track, doubtful=judged(track, 0.05).doubtful), False, 5)


@pytest.mark.parametrize(
    ("confirmed", "chance", "lost"),
    [(True, 0.31, False), (True, 0.29, True), (False, 0.59, True), (False, 0.61, False)],
)
def test_a_new_hand_is_asked_for_more_confidence_than_one_that_was_believed(
    confirmed: bool, chance: float, lost: bool
) -> None:
    status = judged(followed(confirmed=confirmed), chance)
    assert status.lost == lost and status.confidence == pytest.approx(chance)
    assert (status.state_name == "tracking") == (not lost)


def test_a_hand_that_is_wrong_as_a_whole_is_flagged_however_sure_its_joints_are() -> None:
    model = replace(PLAIN, whole=0.5, whole_odds=LogOdds(3.0, {"other_side": -2.0}))
    for other_side, lost in ((0.0, False), (1.4, False), (1.6, True)):
        found = judged(followed(), 0.98, model=model, other_side=other_side)
        assert found.lost == lost and found.whole_odds == pytest.approx(3.0 - 2.0 * other_side)


@pytest.mark.parametrize(
    ("features", "name"),
    [
        ({}, "searching"),
        ({"hidden": 0.5}, "hidden"),
        ({"unseen": 0.5}, "out of view"),
        ({"unseen": 0.5, "hidden": 0.5}, "out of view"),
        ({"unseen": 0.1, "hidden": 0.1}, "searching"),
    ],
)
def test_a_lost_estimate_says_why(features: dict[str, float], name: str) -> None:
    assert judged(followed(), 0.05, **features).state_name == name


def test_the_log_odds_are_smoothed_over_time_but_in_a_first_frame() -> None:
    model, features = replace(PLAIN, memory=0.5), replace(NO_FEATURES, log_score=2.0)
    older, new = followed(log_odds=-2.0), followed(age=Duration(), log_odds=-2.0)
    found = [
        judge(track, features, dt_s, model).log_odds
        for track, dt_s in ((older, FRAME_S), (older, 2 * FRAME_S), (new, FRAME_S))
    ]
    assert found == pytest.approx([0.0, 1.0, 2.0])


@pytest.mark.parametrize("log_odds", [-1e9, -40.0, -2.0, 0.1, 3.0, 1e9])
def test_the_confidence_is_the_probability_of_the_log_odds(log_odds: float) -> None:
    found = probability(log_odds)
    assert found == pytest.approx(1 / (1 + math.exp(-max(min(log_odds, 50), -50))))
    assert 0 <= found <= 1
