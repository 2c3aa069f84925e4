"""When and where the detector is asked, and which of the hands that it finds is taken."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.configured import detector_settings
from helpers.detection import FixedDetector, detection_of
from helpers.rendered import (
    any_hand_model,
    hand_at,
    image_of,
    right_hand_model,
    slot_of,
    track_of,
)

from toftrack.compute.pace import FRAME_S
from toftrack.compute.rigid import PIVOT_M
from toftrack.detector.hand_detector import NO_DETECTION, Detection
from toftrack.detector.proposals import SAME_PLACE_M
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, default_hand_shape
from toftrack.refinement.shape_fit import first_shape, with_network_length
from toftrack.tracking.detect import (
    detect,
    detection_due,
    expected_of,
    is_elsewhere,
    search,
    search_due,
    start_detection,
)
from toftrack.tracking.hands import OtherHand
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.state import HandState, LastSeen, Track

pytestmark = pytest.mark.usefixtures("one_thread")

IMAGE = image_of()


def model_with(detector: FixedDetector, any_side: bool = False) -> TrackerModel:
    return replace(any_hand_model() if any_side else right_hand_model(), detector=detector)


def middle(track: Track) -> np.ndarray:
    """(3,) of the palm."""
    return detection_of(track.pose).centre_m.numpy()


def seen_at(pose: torch.Tensor, age_s: float) -> LastSeen:
    return LastSeen(track_of(pose).mean, age_s)


def other_hand_at(pose: torch.Tensor) -> OtherHand:
    detection, none = detection_of(pose), np.zeros((144, 176), bool)
    return OtherHand(detection.joints_m[0], detection.centre_m.numpy(), True, True, none, none)


def likely_for(hand: HandState, *others: OtherHand):
    """What is known of places besides the image, as a search is given it."""
    detector = FixedDetector()
    search(hand, IMAGE, others, model_with(detector))
    assert detector.likely is not None
    return detector.likely


# What was there before.


# When it is asked.


@pytest.mark.parametrize(
    ("doubted", "every", "searched_s", "due"),
    [
        (None, 1, 0.0, True),
        (True, 1, 0.0, True),
        (False, 1, math.inf, False),
        (None, 5, 4 * FRAME_S, False),
        (None, 5, 5 * FRAME_S, True),
        (None, 5, math.inf, True),
        (True, 5, FRAME_S, False),
    ],
    ids=["no track", "doubted", "believed", "too soon", "in time", "never before", "too soon, too"],
)
def test_the_whole_image_is_searched_while_no_hand_is_believed(
    doubted: bool | None, every: int, searched_s: float, due: bool
) -> None:
    track = None if doubted is None else track_of(hand_at(), doubted=doubted)
    hand = slot_of(track, searched_s=searched_s)
    model = model_with(FixedDetector(search=every))
    assert search_due(hand, model) == due
    if doubted is False:
        assert search_due(hand, model, dt_s=0.2), "where frames are rare, any hand is searched for"


@pytest.mark.parametrize(
    ("changes", "unseen_frames", "due"),
    [
        ({}, 0, False),
        ({}, 1, False),
        ({}, 2, True),
        ({"log_odds": 0.0}, 0, True),
        ({"doubted": True}, 0, True),
    ],
    ids=["sure", "sure, later", "in time", "unsure", "doubted"],
)
def test_the_detector_is_asked_about_a_sure_hand_only_every_few_frames(
    changes: dict[str, object], unseen_frames: int, due: bool
) -> None:
    track = track_of(hand_at(), unseen_s=unseen_frames * FRAME_S, **changes)
    assert detection_due(track, detector_settings(every=3), FRAME_S) == due
    assert detection_due(track, detector_settings(every=1), FRAME_S)


# Where it is asked.


@pytest.mark.parametrize("beside", [False, True])
def test_the_detector_is_asked_where_a_hand_will_be(beside: bool) -> None:
    detector = FixedDetector()
    model, still = model_with(detector), track_of(hand_at())
    velocity = torch.zeros_like(still.velocity)
    velocity[0] = 0.8
    for track in (still, replace(still, velocity=velocity)):
        if beside:
            found = start_detection(slot_of(track), track, IMAGE, model, FRAME_S)()
        else:
            found = detect(slot_of(track), track, IMAGE, model, FRAME_S)
        assert found.centre_m.numpy() == pytest.approx(detector.centres_m[-1][0], abs=1e-4)
    here, moved = (centres[0] for centres in detector.centres_m)
    assert here == pytest.approx(middle(still), abs=0.01)
    assert 0.2 * 0.8 * FRAME_S < moved[0] - here[0] <= 0.8 * FRAME_S


@pytest.mark.parametrize("factor", [0.7, 1.2])
def test_the_detector_is_asked_about_the_middle_of_a_palm_of_that_size(factor: float) -> None:
    detector = FixedDetector()
    model = replace(any_hand_model(), detector=detector)
    track = track_of(hand_at(), model)
    small = with_network_length(
        first_shape(), factor * DEFAULT_HAND_LENGTH_M, model.fit, default_hand_shape()
    )
    hand = slot_of(track, model, shape=small)
    detect(hand, track, IMAGE, model, FRAME_S)
    joints = model.hand(hand.side, small).refiner.joints(track.pose)[0].numpy()
    along = (joints[9] - joints[0]) / np.linalg.norm(joints[9] - joints[0])
    off = detector.centres_m[0][0] - joints[0]
    assert off @ along == pytest.approx(factor * -PIVOT_M[1], abs=0.01)


def test_the_detector_is_asked_about_a_hand_at_the_lens_all_the_same() -> None:
    detector = FixedDetector()
    near = track_of(hand_at(z=0.01))
    detect(slot_of(near), near, IMAGE, model_with(detector), FRAME_S)
    assert detector.centres_m[0][0, 2] >= 0.1


def test_a_detection_is_elsewhere_where_its_palm_is_far_from_the_prediction() -> None:
    track, model = track_of(hand_at()), right_hand_model()
    hand = slot_of(track)

    def elsewhere(x: float) -> bool:
        return is_elsewhere(detection_of(hand_at(x)), hand, track, model, FRAME_S)

    assert [elsewhere(x * SAME_PLACE_M) for x in (0, 0.8, 1.2, -1.2)] == [False, False, True, True]
    assert not is_elsewhere(NO_DETECTION, hand, track, model, FRAME_S)


def test_what_is_expected_of_a_hand_that_is_not_tracked_yet() -> None:
    detection = detection_of(hand_at(0.1))
    expected = expected_of(detection)
    z = detection.joints_m[0, :, 2]
    assert (expected.nearest_m, expected.farthest_m) == (float(z.min()), float(z.max()))
    assert expected.centre_m == pytest.approx(tuple(detection.centre_m.tolist()))


# Which hand is taken.


def searched(found: list[Detection], any_side: bool = False, **changes: object) -> Detection:
    model = model_with(FixedDetector(found), any_side)
    return search(slot_of(None, model, **changes), IMAGE, (), model)


def test_the_best_of_all_places_is_taken() -> None:
    hands = [detection_of(hand_at(0.1)), detection_of(hand_at(-0.1, z=0.3))]
    assert searched(hands) is hands[0]
    assert searched([]).empty


def test_a_hand_that_nobody_described_is_the_one_that_is_held_out() -> None:
    far, near = detection_of(hand_at(0.1, z=0.7)), detection_of(hand_at(-0.1, z=0.4))
    assert searched([far, near], any_side=True) is near
    less_sure = replace(near, error_m=1.9 * near.error_m)
    assert searched([far, less_sure], any_side=True) is less_sure, "both are seen well"
    unsure = replace(near, error_m=2.5 * near.error_m)
    assert searched([far, unsure], any_side=True) is far, "not seen as well"
    known = seen_at(hand_at(0.1, z=0.7), 5.0)
    assert searched([far, near], any_side=True, seen=known) is far, "the best is the same hand"


def test_the_hand_that_is_held_out_is_found_whichever_side_it_is_of() -> None:
    far, near = detection_of(hand_at(0.1, z=0.7)), detection_of(hand_at(-0.1, z=0.4), side="left")

    class OneOfEachSide(FixedDetector):
        def search(self, depth_m, k, side, likely) -> list[Detection]:
            return [near] if side == "left" else [far]

    detector = OneOfEachSide([near])
    model = model_with(detector, any_side=True)
    assert search(slot_of(None, model), IMAGE, (), model) is not far
    np.testing.assert_allclose(detector.centres_m[0][0], near.centre_m.numpy(), atol=1e-6)
    given = model_with(detector, any_side=False)
    assert search(slot_of(None, given), IMAGE, (), given) is far, "its side was given"


def test_where_no_hand_of_a_side_is_found_one_of_the_other_side_may_be_it() -> None:
    class LeftHands(FixedDetector):
        def search(self, depth_m, k, side, likely) -> list[Detection]:
            found = super().search(depth_m, k, side, likely)
            return found if side == "left" else []

    for any_side, sides in ((True, ["right", "left"]), (False, ["right"])):
        detector = LeftHands([detection_of(hand_at(0.1), side="left")])
        model = model_with(detector, any_side)
        found = search(slot_of(None, model), IMAGE, (), model)
        assert detector.searched == sides and found.empty == (not any_side)
    assert len(detector.centres_m) == 0


@pytest.mark.parametrize("age_s", [math.inf, 60.0])
def test_a_hand_never_believed_or_long_ago_may_be_anywhere(age_s: float) -> None:
    likely = likely_for(slot_of(None, seen=seen_at(hand_at(), age_s)))
    assert likely(np.array([0.5, 0.0, 0.5])) == likely(np.array([0.0, 0.0, 1.0])) == 0


def test_a_hand_has_not_jumped_since_it_was_believed() -> None:
    here = middle(track_of(hand_at()))
    aside = here + np.array([0.3, 0.0, 0.0])
    at_once, later = (
        likely_for(slot_of(None, seen=seen_at(hand_at(), age_s))) for age_s in (0.04, 0.8)
    )
    assert at_once(here) == pytest.approx(0, abs=0.01) and at_once(aside) < -1
    assert at_once(aside) < later(aside) < 0, "it may have moved on meanwhile"
    assert at_once(here + 0.02) > at_once(here + 0.05) > at_once(aside)


def test_a_hand_that_was_hardly_believed_may_be_elsewhere() -> None:
    far = np.array([0.3, 0.0, 0.5])
    known = [replace(seen_at(hand_at(), 0.04), surest=surest) for surest in (-3.0, 0.0, 3.0)]
    hardly, perhaps, surely = (likely_for(slot_of(None, seen=seen))(far) for seen in known)
    assert 0 > hardly > perhaps > surely
    assert surely == pytest.approx(-1.5 - 3.0, abs=0.1)
    certain = likely_for(slot_of(None, seen=seen_at(hand_at(), 0.04)))
    assert certain(far) < surely, "then only its speed counts"


def test_another_hand_is_no_place_that_a_hand_has_come_to() -> None:
    likely = likely_for(slot_of(None), other_hand_at(hand_at(0.2)))
    there = middle(track_of(hand_at(0.2)))
    assert likely(there) == -math.inf
    assert likely(there + np.array([2 * SAME_PLACE_M, 0.0, 0.0])) == 0


def test_what_hides_a_hand_is_no_place_that_it_has_come_to() -> None:
    hidden = track_of(hand_at(), doubted=True, nearest_m=0.45)
    likely = likely_for(slot_of(hidden))
    assert likely(np.array([0.0, 0.0, 0.40])) == -math.inf
    assert likely(np.array([0.0, 0.0, 0.46])) == 0
    assert np.isfinite(likely_for(slot_of(replace(hidden, believed=False)))(np.array([0, 0, 0.3])))
    free = likely_for(slot_of(replace(hidden, nearest_m=0.0)))
    assert free(np.array([0.0, 0.0, 0.40])) == 0
