"""Which detection is of which track, and which ones are left over."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.detection import detection_of
from helpers.rendered import EMPTY, hand_at, scene_of, track_of
from scipy.optimize import linear_sum_assignment

from toftrack.compute.pace import FRAME_S
from toftrack.tracking.association import (
    SideDetection,
    assign,
    costs,
    least_cost,
    same_hand,
    unassigned,
)
from toftrack.tracking.state import Track


def seen(x: float, side: str = "right", row: int = -1, **changes: object) -> SideDetection:
    """A hand at a place of the finder, or of the track of a row."""
    return SideDetection(replace(detection_of(hand_at(x), side=side), **changes), side, row)


def costs_of(tracks: list[Track], found: list[SideDetection], dt_s: float = FRAME_S) -> np.ndarray:
    return costs(scene_of(*tracks, image=EMPTY).hands, found, dt_s)


def test_costs_that_are_no_numbers_end_the_search_all_the_same() -> None:
    cost = np.full((2, 3), np.nan)
    assert len(set(least_cost(cost))) == 2


@pytest.mark.parametrize("shape", [(1, 1), (3, 2), (2, 4), (6, 6), (9, 30), (3, 0), (0, 2)])
def test_as_many_tracks_as_possible_have_a_detection_and_none_an_impossible_one(
    shape: tuple[int, int],
) -> None:
    draw = np.random.default_rng(7)
    for impossible in (0.0, 0.0, 0.3, 0.7, 1.0) * 10:
        cost = draw.normal(0, 4, shape)
        cost = cost.round() if draw.random() < 0.5 else cost  # with equal ones
        cost[draw.random(shape) < impossible] = math.inf
        pairs = [(row, column) for row, column in enumerate(assign(cost)) if column >= 0]
        assert len({column for _, column in pairs}) == len(pairs)
        assert all(math.isfinite(cost[pair]) for pair in pairs)
        bounded = np.where(np.isfinite(cost), cost, 1e3)
        best = bounded[linear_sum_assignment(bounded)]
        assert len(pairs) == (best < 1e3).sum()
        assert sum(cost[pair] for pair in pairs) == pytest.approx(best[best < 1e3].sum())


def test_a_detection_costs_the_more_the_farther_it_is_and_none_is_beyond_the_gate() -> None:
    cost = costs_of([track_of(hand_at())], [seen(x) for x in (0.0, 0.05, 0.1, 0.5)])[0]
    assert list(cost) == sorted(cost) and math.isfinite(cost[2]) and cost[3] == math.inf


def test_a_hand_that_was_not_believed_for_long_may_be_farther_off() -> None:
    far = [seen(0.25)]
    assert np.isinf(costs_of([track_of(hand_at())], far)).all()
    assert np.isfinite(costs_of([track_of(hand_at(), believed_s=0.5)], far)).all()
    assert np.isfinite(costs_of([track_of(hand_at())], far, dt_s=0.5)).all()


def test_a_hand_of_the_other_side_is_no_candidate() -> None:
    right, left = track_of(hand_at()), track_of(hand_at(), side="left")
    cost = costs_of([right, left], [seen(0.0), seen(0.0, "left")])
    assert np.isfinite(cost).tolist() == [[True, False], [False, True]]


def test_what_is_seen_at_a_track_s_place_is_no_other_track_s() -> None:
    tracks = [track_of(hand_at()), track_of(hand_at(0.05))]
    own = [seen(0.0, row=0), seen(0.05, "left", row=1)]
    cost = costs_of(tracks, own)
    assert np.isfinite(cost).tolist() == [[True, False], [False, True]]
    assert assign(cost) == [0, 1]


def test_of_two_detections_at_one_place_the_one_for_which_more_speaks_is_taken() -> None:
    found = [seen(0.0, present=0.2), seen(0.0, present=0.9)]
    assert assign(costs_of([track_of(hand_at())], found)) == [1]


def test_what_is_no_track_s_is_left_over_each_hand_once() -> None:
    found = [seen(0.0, row=0), seen(0.005), seen(0.3), seen(0.305), seen(0.3, "left"), seen(-0.3)]
    assert unassigned(found, [0]) == [found[2], found[5]]
    assert unassigned(found[:1], [-1]) == [], "a track's own place begins none"
    assert unassigned(found[2:], [0]) == found[-1:], "nor what a track has taken"


@pytest.mark.parametrize(
    ("apart_m", "behind_m", "one"),
    [(0.0, 0.0, True), (0.015, 0.0, True), (0.0, 0.03, False), (0.06, 0.0, False)],
    ids=["the same", "a little aside", "one behind the other", "beside each other"],
)
def test_two_hands_are_one_where_they_could_not_be_both(
    apart_m: float, behind_m: float, one: bool
) -> None:
    first, second = (detection_of(hand) for hand in (hand_at(), hand_at(apart_m, 0.5 + behind_m)))
    apart = float((first.centre_m - second.centre_m).norm())
    assert same_hand(apart, first.joints_m[0], second.joints_m[0]) == one
    assert same_hand(0.03, first.joints_m[0], first.joints_m[0]), "most of one lies in the other"
