"""What a user gets of a track: cases done by hand."""

import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.evaluation.statistics import interval
from toftrack.evaluation.trust import (
    Trust,
    judged,
    slots_of_hands,
    tips_inset,
    trust,
)
from toftrack.frames.frame import Truth

J = 21


def hand(visible: list[bool], z: float = 0.5, x: float = 0.0) -> Truth:
    """A hand that rests, all joints in one point."""
    joints = np.tile(np.array([x, 0.0, z]), (len(visible), J, 1))
    return Truth(joints, np.array(visible), np.array(visible))


def figures_of(joints: np.ndarray, lost: np.ndarray, true: Truth) -> Trust:
    return trust(judged(joints, lost, true))


def off(true: Truth, mm: list[float]) -> np.ndarray:
    """Estimates of which every joint is so far off in x."""
    joints = true.joints_m.copy()
    joints[:, :, 0] += np.array(mm)[:, None] / 1e3
    return joints


def flags(text: str) -> np.ndarray:
    """'.x.' is false, true, false."""
    return np.array([letter == "x" for letter in text])


def test_each_frame_is_of_one_kind() -> None:
    true = hand([True] * 8)
    joints = off(true, [0, 39.9, 0, 0, 0, 60, 60, 10])  # the last two are flagged lost
    joints[2, 4, 1] += 0.1  # one joint 100 mm away: mean 4.8 mm
    figures = figures_of(joints, flags("......xx"), true)
    assert figures.usable_pct == 100 * 4 / 8
    assert figures.partly_pct == figures.silent_pct == figures.false_alarm_pct == 100 * 1 / 8
    assert (figures.frames, figures.visible, figures.longest_silent) == (8, 8, 1)
    assert figures.mean_mm == pytest.approx((0 + 39.9 + 100 / J + 0 + 0 + 60) / 6)
    assert figures.mean_all_mm == pytest.approx((0 + 39.9 + 100 / J + 0 + 0 + 60 + 60 + 10) / 8)


def test_a_hand_that_went_may_linger_for_three_frames() -> None:
    true = hand([True, True, *[False] * 6, True, True])
    figures = figures_of(true.joints_m, flags(".........."), true)
    assert figures.silent_pct == 100 * 3 / 10  # frames 5, 6, 7
    assert figures.longest_silent == 3
    assert figures.usable_pct == 100


def test_a_hand_that_was_never_there_is_not_forgiven() -> None:
    figures = figures_of(np.zeros((4, J, 3)), flags(".x.."), hand([False] * 4))
    assert (figures.silent_pct, figures.longest_silent) == (75, 2)
    assert (figures.usable_pct, figures.visible) == (0, 0)
    assert figures.mean_mm is None and figures.mean_all_mm is None


def test_an_estimate_that_is_not_finite_counts_as_lost_and_as_far_away() -> None:
    true = hand([True] * 4)
    joints = true.joints_m.copy()
    joints[1, 3, 2], joints[2] = np.inf, np.nan
    figures = figures_of(joints, flags("...."), true)
    assert figures.usable_pct == 50
    assert figures.false_alarm_pct == figures.silent_pct == 0
    assert figures.mean_mm == 0
    assert figures.mean_all_mm == 500  # two frames of a metre each


@pytest.mark.parametrize(
    ("mm", "lost", "first"),
    [
        ([30, 10, 10, 30, 10, 10, 10], ".......", 4),
        ([30, 10, 10, 30, 10, 10, 10], ".....x.", None),
        ([30] * 5 + [0] * 2, ".......", None),  # two frames at the end are too few
        ([25] * 7, ".......", None),
        ([24.9] * 7, ".......", 0),
    ],
)
def test_right_means_three_frames_in_a_row(mm, lost, first) -> None:
    true = hand([True] * 7)
    assert figures_of(off(true, mm), flags(lost), true).first_right == first


def test_found_after_counts_from_each_return() -> None:
    visible = [True] * 3 + [False] * 2 + [True] * 5 + [False] + [True] * 3
    true = hand(visible)
    joints = off(true, [0] * 3 + [0] * 2 + [50, 50, 0, 0, 0] + [0] + [0, 0, 50])
    figures = figures_of(joints, np.zeros(len(visible), bool), true)
    assert figures.first_right == 0
    assert figures.found_after == (2, None)


def test_two_hands_get_the_slots_that_fit_for_the_whole_recording() -> None:
    left, right = hand([True] * 5, x=-0.2), hand([True] * 5, x=0.2)
    joints = np.stack([right.joints_m, left.joints_m], axis=1)
    joints[4:] = joints[4:, ::-1]  # a swap is an error
    lost = np.zeros((5, 2), bool)
    assert slots_of_hands(joints, lost, [left, right]) == (1, 0)
    more = np.concatenate((joints[:, :1] + 0.5, joints), 1)
    assert slots_of_hands(more, np.zeros((5, 3), bool), [left, right]) == (2, 1)
    assert slots_of_hands(joints, lost, [right]) == (0,)
    lost[:, 0] = True  # as bad as far away
    assert slots_of_hands(joints, lost, [right]) == (1,)


@pytest.mark.parametrize("shape", [(3, J, 3), (4, J - 1, 3), (4, 3 * J)])
def test_other_shapes_than_the_truth_are_reported(shape) -> None:
    true = hand([True] * 4)
    with pytest.raises(ToftrackError, match="compare the same joints of the same frames"):
        judged(np.zeros(shape), flags("...."), true)


def test_the_interval_holds_the_mean() -> None:
    share = interval([10.0, 20.0, 90.0])
    assert share.low < share.mean == 40 < share.high
    assert interval([50.0] * 4) == (50, 50, 50)
    many = interval(list(range(100)))  # 90 %: 1.645 standard errors of 2.89 on either side
    assert (many.low, many.high) == pytest.approx((44.75, 54.25), abs=0.4)


def test_fingertips_are_moved_along_the_last_bone() -> None:
    joints = np.zeros((1, J, 3))
    joints[0, 4] = (0, 0.03, 0)
    joints[0, 7], joints[0, 8] = (0.1, 0, 0), (0.1, 0, 0.02)
    moved = tips_inset(joints, 0.005)[0, [4, 8, 7, 20]]
    np.testing.assert_allclose(moved, [(0, 0.025, 0), (0.1, 0, 0.015), (0.1, 0, 0), (0, 0, 0)])
    assert joints[0, 4, 1] == 0.03
