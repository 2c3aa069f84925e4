"""Where tracks begin and end: the table of toftrack/tracking/lifecycle.py, row by row."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from helpers.configured import confidence_model
from helpers.detection import FixedDetector, detection_of
from helpers.rendered import (
    EMPTY,
    any_hand_model,
    frame_of,
    hand_at,
    image_of,
    right_hand_model,
    slot_of,
    track_of,
)

from toftrack.compute.pace import FRAME_S, Duration
from toftrack.detector.hand_detector import SAME_PLACE_M, Detection
from toftrack.frames import DepthImage
from toftrack.refinement.shape_fit import first_shape
from toftrack.tracking.candidates import HandFrame
from toftrack.tracking.confidence import NO_FEATURES
from toftrack.tracking.filter import Filtered, Found
from toftrack.tracking.handedness import HandednessEstimate
from toftrack.tracking.hands import PlacedHand
from toftrack.tracking.lifecycle import (
    Absence,
    Status,
    close,
    judge,
    open_hand,
    reconcile,
    taking_part,
)
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.select import Choice
from toftrack.tracking.state import HandState, Track, TrackerState
from toftrack.tracking.step import conclude

pytestmark = pytest.mark.usefixtures("one_thread")

ELSEWHERE = SAME_PLACE_M + 0.05
HERE, THERE = hand_at(0.0), hand_at(ELSEWHERE)
BOTH = image_of(HERE, THERE)


# In a frame: before it is compared.


@dataclass
class Opened:
    """What became of a slot in a frame.

    began, went_on, away: the track is a new one, or the same as before, or there is none.
    """

    result: HandFrame | Absence
    before: Track | None
    detector: FixedDetector

    @property
    def outcome(self) -> str:
        if isinstance(self.result, Absence):
            return "away" if self.result.hand.track is None else "absent with a track"
        if self.result.track is self.before:
            return "went on"
        return "changed" if self.result.track.age.begun else "began"

    @property
    def x(self) -> float:
        """Where the track is."""
        assert isinstance(self.result, HandFrame)
        return float(self.result.track.pose[0, 0])


def opened(
    track: Track | None,
    found: Sequence[Detection],
    image: DepthImage = BOTH,
    model: TrackerModel | None = None,
    **changes: object,
) -> Opened:
    detector = FixedDetector(found)
    model = replace(model or right_hand_model(), detector=detector)
    hand = slot_of(track, model, **changes)
    return Opened(open_hand(0, hand, (), image, model, FRAME_S), track, detector)


BELIEVED, DOUBTED = track_of(HERE), track_of(HERE, doubted=True)
FOUND_HERE, FOUND_THERE = detection_of(HERE), detection_of(THERE)


@pytest.mark.parametrize(
    ("track", "found", "image", "outcome", "x"),
    [
        (None, [FOUND_HERE], BOTH, "began", 0.0),
        (None, [FOUND_THERE, FOUND_HERE], BOTH, "began", ELSEWHERE),
        (None, [], BOTH, "away", None),
        (None, [], EMPTY, "away", None),
        (None, [FOUND_HERE], EMPTY, "away", None),
        (BELIEVED, [], EMPTY, "away", None),
        (DOUBTED, [], EMPTY, "away", None),
        (DOUBTED, [FOUND_THERE], EMPTY, "away", None),
        (DOUBTED, [FOUND_THERE], BOTH, "began", ELSEWHERE),
        (DOUBTED, [FOUND_HERE], BOTH, "went on", 0.0),
        (DOUBTED, [], BOTH, "went on", 0.0),
        (BELIEVED, [FOUND_THERE], BOTH, "went on", 0.0),
        (BELIEVED, [], BOTH, "went on", 0.0),
    ],
    ids=[
        "begins where a hand is detected",
        "begins with the best",
        "stays away without a detection",
        "stays away in an empty image",
        "stays away where nothing can be a hand",
        "a believed one ends where nothing can be a hand",
        "a doubted one ends where nothing can be a hand",
        "and where a hand was detected elsewhere, too",
        "a doubted one gives way to a hand elsewhere",
        "a doubted one stays where it is detected",
        "a doubted one stays where nothing is detected",
        "a believed one does not give way",
        "a believed one needs no search",
    ],
)
def test_in_a_frame_a_track_begins_goes_on_or_ends(
    track: Track | None,
    found: Sequence[Detection],
    image: DepthImage,
    outcome: str,
    x: float | None,
) -> None:
    after = opened(track, found, image)
    assert after.outcome == outcome
    if x is not None:
        assert after.x == pytest.approx(x, abs=0.02)
    assert bool(after.detector.searched) == (track is not BELIEVED), "the whole image"


def test_the_detector_runs_beside_the_filter_for_a_believed_hand_only() -> None:
    beside, before = opened(BELIEVED, []).result, opened(DOUBTED, []).result
    assert isinstance(beside, HandFrame) and isinstance(before, HandFrame)
    assert beside.detection.empty and not beside.pending().empty
    assert before.pending().empty and not before.detection.empty


def test_a_track_begins_at_the_pose_that_explains_the_image() -> None:
    frame = opened(None, [FOUND_HERE]).result
    assert isinstance(frame, HandFrame)
    joints = frame.fitted.refiner.joints
    assert float((joints(frame.track.pose) - joints(HERE)).norm(dim=-1).mean()) < 0.005
    assert not (frame.track.believed or frame.track.doubted or frame.track.age.begun)


def test_a_track_begins_with_the_length_that_was_detected_and_keeps_it() -> None:
    short = detection_of(HERE, log_size=math.log(0.8))
    model = any_hand_model()
    given = HandednessEstimate(given=True)
    began = opened(None, [short], model=model, handedness=given).result
    assert isinstance(began, HandFrame)
    assert began.fitted.shape.hand_length_m == pytest.approx(0.152, rel=1e-3)
    for track in (BELIEVED, DOUBTED):
        went_on = opened(track, [short], model=model, handedness=given).result
        assert isinstance(went_on, HandFrame)
        assert went_on.fitted.applied == first_shape().applied
    # A hand whose shape is given stays as it is.
    fixed = opened(None, [short]).result
    assert isinstance(fixed, HandFrame)
    assert fixed.fitted.applied == first_shape().applied


# In a frame: the side.

LEFT = image_of(HERE, side="left")
RIGHT = image_of(HERE)
UNSURE = HandednessEstimate(age_s=10.0)


@pytest.mark.parametrize("tracked", [False, True])
def test_a_hand_that_has_become_more_likely_of_the_other_side_begins_anew(tracked: bool) -> None:
    model = any_hand_model()
    track = track_of(HERE, model) if tracked else None
    found = [detection_of(HERE)]
    after = opened(track, found, LEFT, model, handedness=UNSURE)
    assert isinstance(after.result, HandFrame)
    hand = after.result.hand
    assert after.outcome == "began" and hand.side == "left"
    assert after.result.fitted.shape.side == "left"
    assert hand.gesture is None and hand.handedness.probability("left") > 0.6


@pytest.mark.parametrize("tracked", [False, True])
def test_a_hand_of_the_likelier_side_keeps_it(tracked: bool) -> None:
    model = any_hand_model()
    track = track_of(HERE, model) if tracked else None
    after = opened(track, [detection_of(HERE)], RIGHT, model, handedness=UNSURE)
    assert after.result.hand.side == "right"
    assert after.result.hand.handedness.probability("right") > 0.6
    assert after.outcome == ("went on" if tracked else "began")


@pytest.mark.parametrize(
    "handedness",
    [
        HandednessEstimate(given=True, age_s=10.0),
        HandednessEstimate(fits=6.0, age_s=10.0),
        HandednessEstimate(age_s=0.0),
    ],
    ids=["given", "sure for long", "compared a frame ago"],
)
def test_a_side_is_not_changed_against_what_is_known(handedness: HandednessEstimate) -> None:
    model = any_hand_model()
    track = track_of(HERE, model)
    after = opened(track, [detection_of(HERE)], LEFT, model, handedness=handedness)
    assert after.result.hand.side == "right" and after.outcome == "went on"


# After a frame: what is thought of the estimate.

LOST = confidence_model(memory=0.0, confidence=0.3, believe=0.6, second=0.8, give_up=0.1)
PLAIN = replace(LOST, intercept=0.0, weights={"log_score": 1.0}, patience=5)
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
    return judge(track, features, dt_s, side, second, replace(PLAIN, patience=patience))


def frames_until_end(patience: int, dt_s: float = FRAME_S, **features: float) -> int | None:
    """After so many doubtful frames a track ends; None = it does not."""
    track = track_of(HERE)
    for number in range(1, 500):
        status = judged(track, 0.05, patience=patience, dt_s=dt_s, **features)
        if status.ends:
            return number
        track = replace(track, doubtful=status.doubtful)
    return None


@pytest.mark.parametrize(
    ("patience", "features", "frames"),
    [(1, {}, 1), (5, {}, 5), (8, {}, 8), (5, HIDDEN, 50), (1, HIDDEN, 10), (0, {}, None)],
)
def test_a_doubtful_track_ends_after_its_patience_and_a_hidden_one_ten_times_as_late(
    patience: int, features: dict[str, float], frames: int | None
) -> None:
    assert frames_until_end(patience, **features) == frames


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
        judge(track, features, dt_s, 1.0, False, model).log_odds
        for track, dt_s in ((older, FRAME_S), (older, 2 * FRAME_S), (new, FRAME_S))
    ]
    assert found == pytest.approx([0.0, 1.0, 2.0])


# After a frame: the track.


def closed(track: Track, probability: float, **features: float) -> tuple[Status, Track, HandState]:
    """After a frame that finds the hand 10 mm to the right."""
    frame = frame_of(BOTH, track, model=replace(right_hand_model(), lost=PLAIN))
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


def test_the_particles_follow_the_pose_that_was_found() -> None:
    _, after, _ = closed(track_of(HERE), 0.9)
    assert float(after.mean[0, 0]) == pytest.approx(0.01, abs=1e-4)
    assert float(after.particles[:, 0].mean()) == pytest.approx(0.01, abs=1e-3)
    assert after.velocity[0] > 0


def test_a_hand_is_not_remembered_before_its_probation_is_over() -> None:
    for frames in range(1, 8):
        track = track_of(HERE, age=Duration((frames - 1) * FRAME_S))
        _, _, hand = closed(track, 0.9)
        assert hand.seen.ever == (frames > PLAIN.probation)


def concluded(choice: Choice, track: Track, probability: float) -> HandState:
    """The slot's hand after a frame with such a choice."""
    lost = replace(PLAIN, weights={}, intercept=math.log(probability / (1 - probability)))
    frame = frame_of(BOTH, track, FOUND_HERE, model=replace(right_hand_model(), lost=lost))
    filtered = Filtered(track.particles, track.weights, track.mean)
    return conclude(frame, filtered, choice, BOTH, FRAME_S)[1]


def chosen(pose: torch.Tensor, moved: bool) -> Choice:
    return Choice(pose, moved, torch.zeros(0, 27), 0.0, Duration())


def test_a_pose_of_another_place_begins_a_track_there() -> None:
    hand = concluded(chosen(THERE, moved=True), BELIEVED, 0.9)
    assert hand.track is not None and torch.equal(hand.track.pose, THERE)
    assert hand.track.age == Duration(FRAME_S) and hand.track.believed
    assert not hand.track.velocity.any()
    assert bool((hand.track.particles[:, 0] > 0.9 * ELSEWHERE).all())
    stayed = concluded(chosen(HERE, moved=False), BELIEVED, 0.9)
    assert stayed.track is not None and stayed.track.age.seconds > 1


def test_a_track_ends_in_the_frame_in_which_its_patience_does() -> None:
    nearly = replace(BELIEVED, doubtful=Duration(4 * FRAME_S))
    assert concluded(chosen(HERE, moved=False), nearly, 0.05).track is None
    sooner = replace(BELIEVED, doubtful=Duration(3 * FRAME_S))
    assert concluded(chosen(HERE, moved=False), sooner, 0.05).track is not None
    assert concluded(chosen(HERE, moved=False), nearly, 0.2).track is not None


# Two hands.


def two(*tracks: Track | None, **changes: object) -> TrackerState:
    """A state of two slots with their tracks, a right hand's and a left hand's."""
    state = right_hand_model().first_state(0, 2)
    hands = [replace(hand, track=track) for hand, track in zip(state.hands, tracks, strict=True)]
    return replace(state, hands=tuple(hands), **changes)


def afterwards(
    before: TrackerState, after: TrackerState | None = None
) -> tuple[TrackerState, bool]:
    def pose_of(slot: int) -> PlacedHand:
        hand = (after or before).hands[slot]
        assert hand.track is not None
        fitted = right_hand_model().hand("right", hand.shape)
        return PlacedHand(hand.track.pose, fitted, np.eye(3), (1, 1))

    return reconcile(before, after or before, pose_of, FRAME_S)


def followed_after(frames: int, *tracks: Track | None) -> list[bool]:
    """Which of two slots have a track after so many frames alike."""
    state = two(*tracks)
    for _ in range(frames):
        state = afterwards(state)[0]
    return [hand.track is not None for hand in state.hands]


SURE, LESS_SURE = track_of(HERE, log_odds=4.0), track_of(HERE, log_odds=3.0)
NEVER = track_of(HERE, believed=False, log_odds=9.0, age=Duration(FRAME_S))
APART = track_of(hand_at(0.3), log_odds=1.0)


@pytest.mark.parametrize(
    ("tracks", "frames", "expected"),
    [
        ((SURE, LESS_SURE), 3, [True, True]),
        ((SURE, LESS_SURE), 4, [True, False]),
        ((LESS_SURE, SURE), 4, [False, True]),
        ((SURE, NEVER), 1, [True, False]),
        ((NEVER, SURE), 1, [False, True]),
        ((NEVER, replace(NEVER, log_odds=1.0)), 1, [True, False]),
        ((SURE, APART), 50, [True, True]),
        ((SURE, None), 50, [True, False]),
    ],
    ids=[
        "two believed ones are on one hand for three frames",
        "after four the less sure one ends",
        "whichever slot that is",
        "one that was never believed ends at once",
        "whichever slot that is, too",
        "of two that were not, the less sure one",
        "two that are apart go on",
        "and so does one alone",
    ],
)
def test_of_two_tracks_on_one_hand_the_less_sure_one_ends(
    tracks: tuple[Track | None, Track | None], frames: int, expected: list[bool]
) -> None:
    assert followed_after(frames, *tracks) == expected


def test_tracks_that_come_apart_for_a_frame_may_be_on_one_hand_anew() -> None:
    one_hand, parted = two(SURE, LESS_SURE), two(SURE, APART)
    merged = Duration()
    for _ in range(3):
        merged = afterwards(replace(one_hand, merged=merged))[0].merged
    assert merged.begun
    assert not afterwards(replace(parted, merged=merged))[0].merged.begun


@pytest.mark.parametrize(
    ("first", "believed", "age_s", "expected"),
    [
        (SURE, False, 0.4, True),
        (SURE, False, 0.6, False),
        (SURE, True, 0.6, True),
        (NEVER, False, 0.6, True),
        (None, False, 0.6, True),
    ],
    ids=["not yet", "after half a second", "believed", "beside one that is not", "alone"],
)
def test_a_second_hand_that_was_never_believed_ends(
    first: Track | None, believed: bool, age_s: float, expected: bool
) -> None:
    second = replace(APART, believed=believed, age=Duration(age_s))
    state = two(first, second, second_s=0.0)
    after, _ = afterwards(state)
    assert (after.hands[1].track is not None) == expected
    assert (after.second_s < 0) == (not expected), "and is not searched for at once"


@pytest.mark.parametrize(
    ("tracks", "second_s", "slots"),
    [
        ((None, None), 0.0, [0, 1]),
        ((SURE, None), 0.05, [0]),
        ((SURE, None), 0.13, [0, 1]),
        ((None, SURE), 0.05, [1]),
        ((None, SURE), 0.13, [1, 0]),
        ((SURE, LESS_SURE), 0.0, [0, 1]),
        ((LESS_SURE, SURE), 0.0, [1, 0]),
        ((NEVER, LESS_SURE), 0.0, [1, 0]),
    ],
)
def test_the_surest_hand_comes_first_and_a_second_one_is_searched_for_now_and_then(
    tracks: tuple[Track | None, Track | None], second_s: float, slots: list[int]
) -> None:
    assert taking_part(two(*tracks, second_s=second_s)) == slots


def test_a_search_for_a_second_hand_is_the_last_one_for_a_while() -> None:
    for second_s, expected in ((0.13, 0.0), (0.05, 0.05)):
        after, _ = afterwards(two(SURE, None, second_s=second_s))
        assert after.second_s == expected


@pytest.mark.parametrize(
    ("known", "began_in", "side", "exchanged"),
    [
        (("", ""), 0, "right", False),
        (("", ""), 1, "right", True),
        (("right", "left"), 0, "left", True),
        (("right", "left"), 1, "left", False),
        (("right", "left"), 1, "right", True),
        (("left", ""), 1, "left", True),
    ],
)
def test_a_hand_that_comes_back_comes_into_its_slot(
    known: tuple[str, str], began_in: int, side: str, exchanged: bool
) -> None:
    before = two(None, None)

    def remembered(hand: HandState, was: str) -> HandState:
        if not was:
            return hand
        handedness = HandednessEstimate(fits=3.0 if was == "right" else -3.0)
        last = replace(hand.last, lost=False)
        return replace(hand, side=was, handedness=handedness, last=last)

    hands = [remembered(*pair) for pair in zip(before.hands, known, strict=True)]
    before = replace(before, hands=tuple(hands))
    hands[began_in] = replace(hands[began_in], side=side, track=SURE)
    after, swapped = afterwards(before, replace(before, hands=tuple(hands)))
    assert swapped == exchanged
    slot = 1 - began_in if exchanged else began_in
    assert [hand.track is not None for hand in after.hands] == [slot == 0, slot == 1]
    assert after.hands[slot].side == side
    assert after.hands[slot].last is before.hands[slot].last, "what the slot's hand was"
