"""What is thought of an estimate, and what becomes of its track after the frame."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from helpers.configured import confidence_model
from helpers.detection import detection_of
from helpers.rendered import (
    frame_of,
    hand_at,
    image_of,
    right_hand_model,
    track_of,
)

from toftrack.compute.pace import FRAME_S, Duration
from toftrack.detector.proposals import SAME_PLACE_M
from toftrack.frames import DepthImage
from toftrack.tracking.confidence import NO_FEATURES, ConfidenceModel, LogOdds
from toftrack.tracking.filter import Filtered, Found
from toftrack.tracking.handedness import HandednessEstimate
from toftrack.tracking.hands import OtherHand
from toftrack.tracking.lifecycle import (
    Status,
    close,
    judge,
)
from toftrack.tracking.select import Choice
from toftrack.tracking.state import NOWHERE, HandState, LastSeen, Track
from toftrack.tracking.step import conclude

pytestmark = pytest.mark.usefixtures("one_thread")

ELSEWHERE = SAME_PLACE_M + 0.05
HERE, THERE = hand_at(0.0), hand_at(ELSEWHERE)


@cache
def image() -> DepthImage:
    return image_of(HERE, THERE)


LOST = confidence_model(memory=0.0, confidence=0.3, believe=0.6, second=0.8, give_up=0.1)
PLAIN = replace(
    LOST,
    log_odds=LogOdds(0.0, {"log_score": 1.0}),
    whole=0.0,
    whole_odds=LogOdds(0.0, {}),
    patience=5,
)
"""Log odds are just the feature log_score."""
HIDDEN = {"hidden": 0.5}


def judged(
    track: Track,
    probability: float,
    side: float = 1.0,
    second: bool = False,
    dt_s: float = FRAME_S,
    patience: int = 5,
    **features: float,
) -> Status:
    log_odds = math.log(probability / (1 - probability))
    features = replace(NO_FEATURES, log_score=log_odds, **features)
    new = PLAIN.second if second else PLAIN.believe
    model = replace(PLAIN, patience=patience)
    return judge(track, features, dt_s, side, new, model)


def frames_until_end(
    patience: int, dt_s: float = FRAME_S, track: Track | None = None, **features: float
) -> int | None:
    """After so many doubtful frames a track ends; None = it does not."""
    track = track_of(HERE) if track is None else track
    for number in range(1, 500):
        status = judged(track, 0.05, patience=patience, dt_s=dt_s, **features)
        if status.ends:
            return number
        track = replace(track, doubtful=status.doubtful)
    return None


@pytest.mark.parametrize(
    ("patience", "features", "frames"),
    [(1, {}, 1), (5, {}, 5), (8, {}, 8), (5, HIDDEN, 45), (1, HIDDEN, 6), (0, {}, None)],
)
def test_a_doubtful_track_ends_after_its_patience_and_a_hidden_one_much_later(
    patience: int, features: dict[str, float], frames: int | None
) -> None:
    assert frames_until_end(patience, **features) == frames


def test_what_was_never_believed_is_not_waited_for_when_it_is_hidden() -> None:
    assert frames_until_end(5, track=track_of(HERE, believed=False), **HIDDEN) == 5


def test_of_a_hand_that_was_doubtful_before_it_was_hidden_little_patience_is_left() -> None:
    before = judged(track_of(HERE, doubtful=Duration(3 * FRAME_S)), 0.05)
    hidden = track_of(HERE, doubtful=before.doubtful)
    frames = frames_until_end(5, track=hidden, **HIDDEN)
    assert frames is not None
    assert frames <= 10, "one frame is left of five"


def test_patience_is_a_time_but_what_was_dropped_was_not_doubtful() -> None:
    assert frames_until_end(5, dt_s=FRAME_S / 2) == 9, "1 + 8 halves"
    assert frames_until_end(5, dt_s=0.5) == 3, "1 + 2 + 2"


def test_a_frame_that_is_not_doubtful_begins_the_patience_anew() -> None:
    track = track_of(HERE)
    for probability in [0.05] * 4 + [0.2] + [0.05] * 4:
        status = judged(track, probability)
        assert not status.ends
        track = replace(track, doubtful=status.doubtful)
    assert judged(track, 0.05).ends


@pytest.mark.parametrize(
    ("believed", "second", "side", "probability", "lost"),
    [
        (True, False, 1.0, 0.31, False),
        (True, False, 1.0, 0.29, True),
        (True, True, 1.0, 0.31, False),
        (False, False, 1.0, 0.59, True),
        (False, False, 1.0, 0.61, False),
        (False, True, 1.0, 0.61, True),
        (False, True, 1.0, 0.81, False),
        (True, False, 0.5, 0.59, True),
        (True, False, 0.5, 0.61, False),
        (False, False, 0.5, 0.61, False),
    ],
)
def test_an_estimate_is_lost_below_the_confidence_that_is_asked_of_it(
    believed: bool, second: bool, side: float, probability: float, lost: bool
) -> None:
    """A new hand is asked for more, and a second one for still more; a wrong side is wrong."""
    track = track_of(HERE, believed=believed)
    status = judged(track, probability, side=side, second=second)
    assert status.lost == lost
    assert status.confidence == pytest.approx(side * probability)
    assert (status.state_name == "tracking") == (not lost)


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
    assert judged(track_of(HERE), 0.05, **features).state_name == name


def test_the_log_odds_are_smoothed_over_time_but_in_a_first_frame() -> None:
    model = replace(PLAIN, memory=0.5)
    features = replace(NO_FEATURES, log_score=2.0)
    older, new = track_of(HERE, log_odds=-2.0), track_of(HERE, age=Duration(), log_odds=-2.0)
    found = [
        judge(track, features, dt_s, 1.0, 0.0, model).log_odds
        for track, dt_s in ((older, FRAME_S), (older, 2 * FRAME_S), (new, FRAME_S))
    ]
    assert found == pytest.approx([0.0, 1.0, 2.0])


# After a frame: the track.


def closed(
    track: Track,
    probability: float,
    others: tuple[OtherHand, ...] = (),
    handedness: HandednessEstimate | None = None,
    model: ConfidenceModel = PLAIN,
    seen: LastSeen = NOWHERE,
    slot: int = 0,
    **features: float,
) -> tuple[Status, Track, HandState]:
    """After a frame that finds the hand 10 mm to the right."""
    frame = frame_of(image(), track, others=others, model=replace(right_hand_model(), lost=model))
    frame = replace(frame, slot=slot, hand=replace(frame.hand, seen=seen))
    if handedness is not None:
        frame = replace(frame, hand=replace(frame.hand, handedness=handedness))
    moved = hand_at(0.01)
    filtered = Filtered(track.particles, track.weights, track.mean)
    found = Found(filtered, moved, track.trend, *frame.model.nearest(moved))
    log_odds = math.log(probability / (1 - probability))
    features_now = replace(NO_FEATURES, log_score=log_odds, **features)
    status, after, last_seen = close(frame, found, features_now, FRAME_S)
    return status, after, replace(frame.hand, seen=last_seen)


@pytest.mark.parametrize(("probability", "lost"), [(0.9, False), (0.2, True)])
@pytest.mark.parametrize("believed", [False, True])
def test_a_track_is_believed_once_and_doubted_while_it_is_lost(
    probability: float, lost: bool, believed: bool
) -> None:
    track = track_of(HERE, believed=believed)
    status, after, hand = closed(track, probability)
    assert status.lost == after.doubted == lost
    assert after.believed == (believed or not lost)
    assert after.age.seconds == pytest.approx(track.age.seconds + FRAME_S)
    assert hand.seen.ever == (not lost), "remembered as last believed"


def test_a_new_hand_is_believed_that_is_right_as_a_whole_whatever_its_fingers() -> None:
    for odds, lost in ((3.0, False), (1.0, True)):
        model = replace(PLAIN, whole_odds=LogOdds(odds, {}))
        assert closed(track_of(HERE, believed=False), 0.4, model=model)[0].lost == lost


def beside(watched: bool) -> OtherHand:
    """Another hand that is believed."""
    none = np.zeros((2, 2), bool)
    joints = 1.0 + torch.arange(63.0).view(21, 3)
    return OtherHand(joints, np.ones(3), True, True, none, none, watched)


@pytest.mark.parametrize("watched", [False, True])
def test_beside_another_hand_a_new_one_must_be_surer_whether_that_is_reported_or_not(
    watched: bool,
) -> None:
    track = track_of(HERE, believed=False)
    between = 0.5 * (PLAIN.believe + PLAIN.second)
    assert not closed(track, between)[0].lost
    assert closed(track, between, (beside(watched),))[0].lost
    assert not closed(track, 0.97, (beside(watched),))[0].lost


def test_the_second_of_two_hands_is_asked_for_less_than_a_first_one() -> None:
    """Where one hand is, there is a person, whose other hand is no surprise."""
    sooner = replace(PLAIN, second=0.4)
    new = track_of(HERE, believed=False)

    def lost(slot: int, *others: OtherHand) -> bool:
        return closed(new, 0.5, others, model=sooner, slot=slot)[0].lost

    assert not lost(1, beside(False))
    assert lost(1, beside(True)), "it is beside one that nobody asked for"
    assert lost(0, beside(False)) and lost(1), "the first hand is not"


def test_the_particles_follow_the_pose_that_was_found() -> None:
    _, after, _ = closed(track_of(HERE), 0.9)
    assert float(after.mean[0, 0]) == pytest.approx(0.01, abs=1e-4)
    assert float(after.particles[:, 0].mean()) == pytest.approx(0.01, abs=1e-3)
    assert after.velocity[0] > 0


def concluded(choice: Choice, track: Track, probability: float) -> HandState:
    """The slot's hand after a frame with such a choice."""
    lost = replace(PLAIN, log_odds=LogOdds(math.log(probability / (1 - probability)), {}))
    frame = frame_of(
        image(), track, detection_of(HERE), model=replace(right_hand_model(), lost=lost)
    )
    filtered = Filtered(track.particles, track.weights, track.mean)
    return conclude(frame, filtered, choice, image(), FRAME_S)[1]


def chosen(pose: torch.Tensor, moved: bool) -> Choice:
    return Choice(pose, moved)


def test_a_pose_of_another_place_begins_a_track_there() -> None:
    hand = concluded(chosen(THERE, moved=True), track_of(HERE), 0.9)
    assert hand.track is not None and torch.equal(hand.track.pose, THERE)
    assert hand.track.age == Duration(FRAME_S) and hand.track.believed
    assert not hand.track.velocity.any()
    assert bool((hand.track.particles[:, 0] > 0.9 * ELSEWHERE).all())
    stayed = concluded(chosen(HERE, moved=False), track_of(HERE), 0.9)
    assert stayed.track is not None and stayed.track.age.seconds > 1


def test_a_track_ends_in_the_frame_in_which_its_patience_does() -> None:
    nearly = track_of(HERE, doubtful=Duration(4 * FRAME_S))
    assert concluded(chosen(HERE, moved=False), nearly, 0.05).track is None
    sooner = track_of(HERE, doubtful=Duration(3 * FRAME_S))
    assert concluded(chosen(HERE, moved=False), sooner, 0.05).track is not None
    assert concluded(chosen(HERE, moved=False), nearly, 0.2).track is not None
