"""A second hand is searched for beside the first one, a part of the search in each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.detection import FixedDetector, detection_of
from helpers.rendered import WALL_M, hand_at, image_of, right_hand_model, track_of

from toftrack.compute.pace import FRAME_S
from toftrack.detector.proposals import SAME_PLACE_M
from toftrack.tracking.detect import reachable
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.seeking import detect_again, sought, start_seeking, taking_part
from toftrack.tracking.state import LastSeen, Track, TrackerState
from toftrack.tracking.tracker import HandsTracker

pytestmark = pytest.mark.usefixtures("one_thread")

HERE, THERE = hand_at(0.0), hand_at(0.3)
IMAGE = image_of(HERE, THERE)


def searching(*found: torch.Tensor) -> TrackerModel:
    """Its finder finds hands at these places."""
    return replace(right_hand_model(), detector=FixedDetector([detection_of(one) for one in found]))


def followed(*tracks: Track | None, **changes: object) -> TrackerState:
    state = right_hand_model().first_state(0, 2)
    hands = [replace(hand, track=track) for hand, track in zip(state.hands, tracks, strict=True)]
    return replace(state, hands=tuple(hands), **{"second_s": 1.0, **changes})


def frames(state: TrackerState, model: TrackerModel, count: int) -> list[TrackerState]:
    """The states after a part of the search in each of so many frames."""
    after = []
    for _ in range(count):
        state = sought(*start_seeking(state, IMAGE, model, FRAME_S), model)
        after.append(state)
    return after


def centres(model: TrackerModel) -> np.ndarray:
    """Where the pose network was asked."""
    return np.array(model.detector.centres_m).reshape(-1, 3)


def test_a_slot_takes_part_when_its_hand_is_found_and_not_before() -> None:
    model = searching(HERE, THERE)
    before = followed(track_of(HERE), None)
    parts = [taking_part(state, 2.0) for state in (before, *frames(before, model, 2))]
    assert parts == [[0], [0], [0, 1]]


def test_what_was_found_is_detected_again_where_it_is_now() -> None:
    model = searching(THERE)
    hand = frames(followed(track_of(HERE), None), model, 2)[-1].hands[1]
    assert hand.seeking is not None
    again = detect_again(hand, hand.seeking, IMAGE, (), model)
    expected = detection_of(THERE).centre_m.numpy()
    np.testing.assert_allclose(again.centre_m.numpy(), expected, atol=1e-3)


@pytest.mark.parametrize(
    ("tracks", "searched"),
    [
        ((track_of(HERE), None), True),
        ((track_of(HERE), track_of(THERE, doubted=True)), True),
        ((track_of(HERE, doubted=True), None), False),
        ((track_of(HERE, believed=False), None), False),
        ((track_of(HERE), track_of(THERE)), False),
        ((None, None), False),
    ],
    ids=["none", "doubted", "first doubted", "first never believed", "both", "neither"],
)
def test_a_hand_is_searched_for_beside_one_that_is_believed(
    tracks: Sequence[Track | None], searched: bool
) -> None:
    model = searching(THERE)
    frames(followed(*tracks), model, 1)
    assert bool(model.detector.searched) == searched


def test_a_search_without_a_hand_ends_and_waits_for_the_next() -> None:
    model = searching()
    state = frames(followed(track_of(HERE), None), model, 2)[-1]
    assert state.hands[1].seeking is None and taking_part(state, 2.0) == [0]
    assert len(model.detector.searched) == 1


@pytest.mark.parametrize(
    ("last_m", "watched", "again"),
    [(0.06, False, True), (0.12, False, False), (None, False, False), (0.06, True, False)],
    ids=["touching", "apart", "never seen", "watched"],
)
def test_a_hand_that_touched_the_other_is_searched_for_without_the_other(
    last_m: float | None, watched: bool, again: bool
) -> None:
    model = searching(HERE)  # the finder sees nothing but the first hand
    before = followed(track_of(HERE), None, watched=watched, second_s=10.0)
    hand = before.hands[1]
    if last_m is not None:
        hand = replace(hand, seen=LastSeen(track_of(hand_at(last_m)).mean, 0.2))
    before = replace(before, hands=(before.hands[0], hand))
    first, second = frames(before, model, 2)
    assert (first.hands[1].seeking is not None) == again
    assert taking_part(first, 2.0) == [0]
    assert second.hands[1].seeking is None, "it is over"
    images = model.detector.images
    assert len(images) == 1 + again
    np.testing.assert_array_equal(images[0], IMAGE.depth_m)
    if again:
        gone, hand = images[1] > WALL_M, image_of(HERE).depth_m < WALL_M
        assert gone[hand].mean() > 0.9 and not gone[image_of(THERE).depth_m < WALL_M].any()


def test_a_search_for_a_doubted_hand_goes_on_over_the_frames_that_it_is_followed_in() -> None:
    tracker = HandsTracker(searching(THERE), 0, 2)
    away = hand_at(-0.1)
    tracker.state = followed(track_of(HERE), track_of(away, doubted=True))
    kept = []
    for frame in range(2):
        tracker.step(IMAGE.depth_m, IMAGE.k, frame, frame * FRAME_S)
        kept.append(tracker.state.hands[1].seeking)
    assert kept[0] is not None and len(kept[0].centres_m) == 1
    assert kept[1] is not None and len(kept[1].seen) == 1, "the next frame begins there"


@pytest.mark.parametrize(("watched", "patience_s"), [(False, 1.5), (True, 6.0)])
def test_what_was_no_hand_is_left_alone_for_a_while(watched: bool, patience_s: float) -> None:
    place = detection_of(HERE).centre_m.numpy()
    hand = replace(followed(None, None).hands[0], watched=watched)
    assert reachable(hand, [], place) == 0
    for age_s, expected in ((0.9 * patience_s, -np.inf), (1.1 * patience_s, 0.0)):
        tried = replace(hand, tried=LastSeen(track_of(HERE).mean, age_s))
        assert reachable(tried, [], place) == expected
        assert reachable(tried, [], place + 2 * SAME_PLACE_M) == 0
