"""Two tracks: none on the other's hand, each in its slot, the second one now and then."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from helpers.rendered import (
    hand_at,
    right_hand_model,
    track_of,
)

from toftrack.compute.pace import FRAME_S, Duration
from toftrack.tracking.handedness import OTHER_SIDE, HandednessEstimate
from toftrack.tracking.hands import PlacedHand
from toftrack.tracking.lifecycle import reconcile
from toftrack.tracking.seeking import due_slots, since_search
from toftrack.tracking.state import HandState, Track, TrackerState

pytestmark = pytest.mark.usefixtures("one_thread")

HERE = hand_at()


@cache
def known_tracks() -> dict[str, Track]:
    """Three on one hand, of which one was never believed, and one of another hand."""
    never = {"believed": False, "age": Duration(FRAME_S)}
    return {
        "sure": track_of(HERE, log_odds=4.0),
        "less sure": track_of(HERE, log_odds=3.0),
        "new": track_of(HERE, log_odds=9.0, **never),
        "doubtful": track_of(HERE, log_odds=1.0, **never),
        "other fingers": track_of(bent_fist(0.015), log_odds=3.0),
        "30 mm behind": track_of(bent_fist(0.03), log_odds=3.0),
        "apart": track_of(hand_at(0.3), log_odds=1.0),
    }


def bent_fist(behind_m: float) -> torch.Tensor:
    """(1, 27) a fist about the palm of HERE, or behind it."""
    state = HERE.clone()
    state[0, 2] += behind_m
    for finger in range(12, 27, 4):
        state[0, finger : finger + 3] = 1.3
    return state


def two(*names: str | None, **changes: object) -> TrackerState:
    """A state of two slots with their tracks, a right hand's and a left hand's."""
    state, tracks = right_hand_model().first_state(0, 2), [known_tracks().get(n) for n in names]
    hands = [replace(hand, track=track) for hand, track in zip(state.hands, tracks, strict=True)]
    return replace(state, hands=tuple(hands), **changes)


def afterwards(
    before: TrackerState, after: TrackerState | None = None
) -> tuple[TrackerState, bool]:
    def place(hand: HandState, track: Track) -> PlacedHand:
        fitted = right_hand_model().hand("right", hand.shape)
        return PlacedHand(track.pose, fitted, np.eye(3), (1, 1))

    return reconcile(before, after or before, place, FRAME_S)


def followed_after(frames: int, *names: str | None) -> list[bool]:
    """Which of two slots have a track after so many frames alike."""
    state = two(*names)
    for _ in range(frames):
        state = afterwards(state)[0]
    return [hand.track is not None for hand in state.hands]


@pytest.mark.parametrize(
    ("tracks", "frames", "expected"),
    [
        (("sure", "less sure"), 3, [True, True]),
        (("sure", "less sure"), 4, [True, False]),
        (("less sure", "sure"), 4, [False, True]),
        (("sure", "new"), 1, [True, False]),
        (("new", "sure"), 1, [False, True]),
        (("new", "doubtful"), 1, [True, False]),
        (("sure", "other fingers"), 4, [True, False]),
        (("sure", "30 mm behind"), 50, [True, True]),
        (("sure", "apart"), 50, [True, True]),
        (("sure", None), 50, [True, False]),
    ],
    ids=[
        "two believed ones are on one hand for three frames",
        "after four the less sure one ends",
        "whichever slot that is",
        "one that was never believed ends at once",
        "whichever slot that is, too",
        "of two that were not, the less sure one",
        "of two in one palm with other fingers, too",
        "two that lie on each other go on",
        "two that are apart go on",
        "and so does one alone",
    ],
)
def test_of_two_tracks_on_one_hand_the_less_sure_one_ends(
    tracks: tuple[str | None, str | None], frames: int, expected: list[bool]
) -> None:
    assert followed_after(frames, *tracks) == expected


def test_tracks_that_come_apart_for_a_frame_may_be_on_one_hand_anew() -> None:
    one_hand, parted = two("sure", "less sure"), two("sure", "apart")
    merged = Duration()
    for _ in range(3):
        merged = afterwards(replace(one_hand, merged=merged))[0].merged
    assert merged.begun
    assert not afterwards(replace(parted, merged=merged))[0].merged.begun


@pytest.mark.parametrize(
    ("first", "believed", "age_s", "expected"),
    [
        ("sure", False, 0.4, True),
        ("sure", False, 0.6, False),
        ("sure", True, 0.6, True),
        ("new", False, 0.6, True),
        (None, False, 0.6, True),
    ],
    ids=["not yet", "after half a second", "believed", "beside one that is not", "alone"],
)
def test_a_second_hand_that_was_never_believed_ends(
    first: str | None, believed: bool, age_s: float, expected: bool
) -> None:
    state = two(first, "apart", second_s=0.0)
    track = replace(known_tracks()["apart"], believed=believed, age=Duration(age_s))
    state = replace(state, hands=(state.hands[0], replace(state.hands[1], track=track)))
    after, _ = afterwards(state)
    assert (after.hands[1].track is not None) == expected
    assert (after.second_s < 0) == (not expected), "and is not searched for at once"


@pytest.mark.parametrize(("watched", "ends"), [(True, False), (False, True)])
def test_the_hand_that_is_asked_for_need_not_be_believed_beside_the_watched_one(
    watched: bool, ends: bool
) -> None:
    state = two("apart", "sure", second_s=0.0, watched=watched)
    track = replace(known_tracks()["apart"], believed=False, age=Duration(2.0))
    state = replace(state, hands=(replace(state.hands[0], track=track), state.hands[1]))
    after, _ = afterwards(state)
    assert (after.hands[0].track is None) is ends and after.hands[1].track is not None


@pytest.mark.parametrize(
    ("tracks", "second_s", "slots"),
    [
        ((None, None), 0.0, [0, 1]),
        (("sure", None), 0.05, [0]),
        (("sure", None), 0.13, [0, 1]),
        ((None, "sure"), 0.05, [1]),
        ((None, "sure"), 0.13, [1, 0]),
        (("sure", "less sure"), 0.0, [0, 1]),
        (("less sure", "sure"), 0.0, [1, 0]),
        (("new", "less sure"), 0.0, [1, 0]),
    ],
)
def test_the_surest_hand_comes_first_and_a_second_one_is_searched_for_now_and_then(
    tracks: tuple[str | None, str | None], second_s: float, slots: list[int]
) -> None:
    assert due_slots(two(*tracks, second_s=second_s), 0.5) == slots


def test_a_search_for_a_second_hand_is_the_last_one_for_a_while() -> None:
    for second_s, expected in ((0.13, 0.0), (0.05, 0.05)):
        state = two("sure", None, second_s=second_s)
        assert since_search(state, due_slots(state, 0.5)) == expected


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
    hands[began_in] = replace(hands[began_in], side=side, track=known_tracks()["sure"])
    after, swapped = afterwards(before, replace(before, hands=tuple(hands)))
    assert swapped == exchanged
    slot = 1 - began_in if exchanged else began_in
    assert [hand.track is not None for hand in after.hands] == [slot == 0, slot == 1]
    assert after.hands[slot].side == side
    assert after.hands[slot].last is before.hands[slot].last, "what the slot's hand was"


@pytest.mark.parametrize("lost", [True, False])
def test_where_a_side_is_given_no_hand_of_the_other_side_comes_into_the_first_slot(
    lost: bool,
) -> None:
    before = two(None, None)
    first = before.hands[0]
    given = replace(first.handedness, given=True)
    first = replace(first, handedness=given, last=replace(first.last, lost=lost))
    second = replace(before.hands[1], side=OTHER_SIDE[first.side])
    before = replace(before, hands=(first, second))
    came = replace(second, track=known_tracks()["sure"])
    after, swapped = afterwards(before, replace(before, hands=(first, came)))
    assert not swapped and after.hands[0] is first
    assert after.hands[1].track is not None
