"""One hand is asked for: a second one in view is known, and never taken for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.rendered import hand_at, right_hand_model, track_of
from helpers.tracking import configuration, sample
from helpers.two_hands import beside_its_mirror

from toftrack.api import build_hands_tracker
from toftrack.estimate import Estimate
from toftrack.tracking.handedness import HandednessEstimate, HandednessSettings
from toftrack.tracking.hands import partnered
from toftrack.tracking.seeking import due_slots
from toftrack.tracking.state import TrackerState
from toftrack.tracking.watching import first_estimate, watched_over

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL = ("filter.particles=80",)


def watching(first: bool, other: bool, **changes: object) -> TrackerState:
    """One hand that is asked for and one that is watched, each followed or not."""
    model, here = right_hand_model(), hand_at()
    state = model.first_state(0)
    hands = [
        replace(hand, track=track_of(here, model) if followed else None)
        for hand, followed in zip(state.hands, (first, other), strict=True)
    ]
    hands[0] = replace(hands[0], handedness=HandednessEstimate(given=True, prior=2.0))
    return replace(state, hands=tuple(hands), **changes)


@pytest.mark.parametrize(
    ("first", "other", "second_s", "slots"),
    [
        (False, False, 9.0, [0]),
        (False, False, np.inf, [1, 0]),
        (True, False, 0.4, [0]),
        (True, False, 0.6, [0, 1]),
        (False, True, 0.04, [1]),
        (False, True, 0.08, [1, 0]),
        (True, True, 0.0, [0, 1]),
    ],
    ids=[
        "nobody: the one that was asked for is searched for",
        "what has just turned out to be the other hand is found as such",
        "another one is not looked for at once",
        "but now and then",
        "and the one that was asked for",
        "more often",
        "both",
    ],
)
def test_a_frame_is_about_these_hands(
    first: bool, other: bool, second_s: float, slots: list[int]
) -> None:
    assert due_slots(watching(first, other, second_s=second_s), 0.5) == slots


def with_evidence(state: TrackerState, slot: int, **changes: object) -> TrackerState:
    hands = list(state.hands)
    hands[slot] = replace(hands[slot], handedness=replace(hands[slot].handedness, **changes))
    return replace(state, hands=tuple(hands))


def test_what_is_surely_of_the_other_side_is_followed_as_the_other_hand() -> None:
    settings = HandednessSettings()
    unsure = watched_over(with_evidence(watching(True, False), 0, fits=-2.5), settings)
    assert unsure.hands[0].track is not None
    after = watched_over(with_evidence(watching(True, False), 0, fits=-6.0), settings)
    first, other = after.hands
    assert first.track is None and first.side == "right" and first.handedness.given
    assert other.side == "left" and not other.handedness.given
    reported = first_estimate(first.last, after)
    assert reported.lost and reported.state_name == "other hand"


@pytest.mark.parametrize(("fits", "lost"), [(-0.5, True), (2.0, False)])
def test_of_two_hands_of_the_given_side_only_a_sure_one_is_reported(
    fits: float, lost: bool
) -> None:
    state = with_evidence(watching(True, True), 0, fits=fits)
    first, other = (replace(h, track=replace(h.track, believed=True)) for h in state.hands)
    said = replace(first.last, lost=False, gesture="point", pinch=0.8, pinching=True)
    said = replace(said, pointing_direction=np.eye(3, dtype=np.float32)[0])
    assert not first_estimate(said, replace(state, hands=(first, other))).lost, "of two sides"
    alike = replace(state, hands=(first, replace(other, side=first.side)))
    found = first_estimate(said, alike)
    assert found.lost == lost and (found.state_name == "other hand") == lost
    assert not (lost and found.joint_ok.any())
    assert (found.gesture == "") == np.isnan(found.pinch) == lost and found.pinching != lost
    assert np.isnan(found.pointing_direction).all() == lost
    unsure = replace(other, side=first.side, track=replace(other.track, believed=False))
    assert not first_estimate(said, replace(state, hands=(first, unsure))).lost


def test_only_a_hand_that_was_never_beside_the_first_one_can_be_it_after_all() -> None:
    state = with_evidence(watching(False, True), 1, fits=5.0)
    known = replace(state.hands[1], side="right")
    after = watched_over(replace(state, hands=(state.hands[0], known)), HandednessSettings())
    assert after.hands[0].track is not None and after.hands[1].track is None
    beside = replace(known, beside=True)
    after = watched_over(replace(state, hands=(state.hands[0], beside)), HandednessSettings())
    assert after.hands[0].track is None and after.hands[1].track is not None


@pytest.mark.parametrize(
    ("fits", "beside", "away_s", "back"),
    [
        (2.0, False, 0.5, True),
        (0.0, False, 0.5, False),
        (2.0, True, 0.5, False),
        (0.0, True, 3, True),
    ],
    ids=["of the same side", "perhaps of the other", "beside the first one before", "long after"],
)
def test_where_no_side_was_given_a_hand_that_comes_back_is_the_first_one_again(
    fits: float, beside: bool, away_s: float, back: bool
) -> None:
    state = with_evidence(watching(False, True), 1, fits=fits)
    first, other = state.hands
    assert other.track is not None
    seen = replace(first.seen, age_s=away_s)
    first = replace(first, handedness=HandednessEstimate(given=False), seen=seen)
    track = replace(other.track, believed=True)
    other = replace(other, side=first.side, beside=beside, track=track)
    after = watched_over(replace(state, hands=(first, other)), HandednessSettings())
    assert (after.hands[0].track is track) == back


def test_of_two_hands_the_one_that_rather_is_of_the_given_side_is_the_first() -> None:
    settings = HandednessSettings()
    state = with_evidence(watching(True, True), 0, fits=-0.6)
    state = with_evidence(state, 1, fits=0.6, comparisons=3)
    given, other = partnered(
        (state.hands[0], replace(state.hands[1], side="right")), right_hand_model()
    )
    assert given.track is not None and other.track is not None
    followed = replace(given.track, pose=given.track.pose + 0.01)
    state = replace(state, hands=(replace(given, track=followed), other))
    after = watched_over(state, settings)
    assert after.hands[0].track is other.track and after.hands[1].track is None
    for less in (
        replace(other, handedness=replace(other.handedness, comparisons=2)),
        replace(other, track=replace(other.track, log_odds=followed.log_odds - 1.1)),
    ):
        kept = watched_over(replace(state, hands=(state.hands[0], less)), settings)
        assert kept.hands[0].track is followed, "seldom compared, or hardly a hand"
    assert after.hands[0].handedness.given and after.second_s == np.inf
    as_given = with_evidence(with_evidence(state, 0, fits=0.6, partner=0.6), 1, fits=-0.6)
    assert watched_over(as_given, settings).hands[0].track is followed


@pytest.mark.parametrize(
    ("believed", "beside", "fits", "exchanged"),
    [
        (False, False, 1.1, True),
        (False, False, 0.7, False),
        (True, False, 1.1, False),
        (False, True, 1.1, False),
    ],
    ids=[
        "what nobody believed makes way",
        "not for one that is as doubtful",
        "what was believed stays",
        "not for what is known to be the other hand",
    ],
)
def test_a_first_hand_that_nobody_believed_makes_way_for_one_that_rather_is_it(
    believed: bool, beside: bool, fits: float, exchanged: bool
) -> None:
    state = with_evidence(with_evidence(watching(True, True), 0, fits=-0.2), 1, fits=fits)
    given, other = state.hands
    assert given.track is not None and other.track is not None
    given = replace(given, track=replace(given.track, believed=believed))
    other = replace(other, side="right", beside=beside, track=replace(other.track, believed=beside))
    after = watched_over(replace(state, hands=(given, other)), HandednessSettings())
    assert (after.hands[0].track is other.track) is exchanged


def follow(depth_m: np.ndarray, k: np.ndarray, *overrides: str) -> list[Estimate]:
    """The first slot's estimates, another hand being looked for every 0.1 s."""
    tracker = build_hands_tracker(configuration(*SMALL, *overrides))
    often = replace(tracker.model.configured, handedness=HandednessSettings(watch_s=0.1))
    tracker.model = replace(tracker.model, configured=often)
    return [tracker.step(depth, k, i, i / 25)[0] for i, depth in enumerate(depth_m)]


def test_the_other_hand_is_not_taken_for_one_that_has_left() -> None:
    rows = range(14, 32)
    both = beside_its_mirror(sample().cut(*rows), 30)
    alone = np.where(both.depth_m == sample().cut(*rows).depth_m, 1.5, both.depth_m)
    depth = np.concatenate((both.depth_m[:8], alone[8:]))
    found = follow(depth.astype(np.float32), both.k, "hand.side=right")
    off = [np.linalg.norm(found[i].joints_m - both.joints_m[0, i], axis=1).mean() for i in range(8)]
    assert not any(e.lost for e in found[3:8]) and max(off[3:8]) < 0.03
    assert all(e.lost for e in found[12:])
    assert found[-1].state_name == "other hand" and {e.side for e in found} == {"right"}
