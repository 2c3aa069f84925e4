"""What a user gets of a track: how many frames are usable, silently wrong, or needlessly refused.

Against ground truth, over all poses. A joint is right within 40 mm, an estimate wrong when its mean
joint error exceeds 40 mm. An estimate that is not finite counts as flagged lost, and as infinitely
far away wherever frames flagged lost count as well.

| figure | of | which frames |
| --- | --- | --- |
| usable | visible frames | not flagged lost, every joint within 40 mm |
| partly | visible frames | not flagged, mean error at most 40 mm, but some joint is farther off |
| false alarm | visible frames | flagged lost although every joint is within 40 mm |
| silent | all frames | not flagged, and the mean error exceeds 40 mm, or no hand is visible |

A frame without a visible hand is silent only from the fourth frame after the hand went: up to three
are forgiven. The track is right from the first of three visible, unflagged frames in a row that
have a mean error below 25 mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.evaluation.statistics import figure, share_pct
from toftrack.frames.frame import Truth

TIPS = (4, 8, 12, 16, 20)
"""Rows of the fingertips among the 21 joints."""
OK_MM = 40.0
"""The largest error of a joint that can be used, and the largest mean error that is not wrong."""
RIGHT_MM = 25.0
RIGHT_FRAMES = 3
MOST_MM = 1e3
"""The most that one frame counts for in a mean over flagged frames, too."""
FORGIVEN_FRAMES = 3
"""So many frames after the hand went may still say that it is there."""

_NOWHERE_M = 1e3
"""Where an estimate that is not finite is taken to be."""
_MISS_M = 0.1
"""The most that one frame adds to the cost of giving a slot to a hand."""


@dataclass(frozen=True)
class Trust:
    """The figures of one track of one hand, see the head of this module. Shares in per cent.

    visible: frames that show the hand.  longest_silent: frames of the longest run.
    mean_mm: mean joint error over visible frames that are not flagged lost; None: there are none.
    mean_all_mm: the same over all visible frames; one frame counts for at most a metre.
    first_right: the frame from which the track is right for the first time; None: never.
    found_after: each time that the hand becomes visible again, frames until the track is right.
    """

    frames: int
    visible: int
    usable_pct: float
    partly_pct: float
    false_alarm_pct: float
    silent_pct: float
    longest_silent: int
    mean_mm: float | None
    mean_all_mm: float | None
    first_right: int | None
    found_after: tuple[int | None, ...]


@dataclass(frozen=True, eq=False)
class Judged:
    """What each of T frames is, see the head of this module: (T,) bool, but for the errors.

    seen: the hand is visible.  there: there is an estimate.  said: one that is not flagged lost.
    error_mm: (T, J) of `joint_errors_mm`.  mean_mm: (T,) their means.
    """

    seen: np.ndarray
    there: np.ndarray
    said: np.ndarray
    usable: np.ndarray
    partly: np.ndarray
    false_alarm: np.ndarray
    silent: np.ndarray
    error_mm: np.ndarray
    mean_mm: np.ndarray


def trust(of: Judged) -> Trust:
    """The figures of a track whose frames were judged, unrounded."""
    average, seen = of.mean_mm, of.seen
    right = steady(seen & of.said & (average < RIGHT_MM))
    returns = np.flatnonzero(seen[1:] & ~seen[:-1]) + 1
    return Trust(
        frames=len(seen),
        visible=int(seen.sum()),
        usable_pct=share_pct(of.usable, seen) or 0.0,
        partly_pct=share_pct(of.partly, seen) or 0.0,
        false_alarm_pct=share_pct(of.false_alarm, seen) or 0.0,
        silent_pct=share_pct(of.silent, seen | True) or 0.0,
        longest_silent=longest_run(of.silent),
        mean_mm=figure(average[seen & of.said]),
        mean_all_mm=figure(np.minimum(average[seen], MOST_MM)),
        first_right=until(right, 0),
        found_after=tuple(until(right, int(frame)) for frame in returns),
    )


def judged(joints_m: np.ndarray, lost: np.ndarray, truth: Truth) -> Judged:
    """What each frame of a track is.

    joints_m: (T, J, 3) metres, camera frame, not finite where there is none; J need not be 21.
    lost: (T,) bool.  Raises ToftrackError: estimates and truth differ in shape.
    """
    estimate, lost = np.asarray(joints_m, np.float64), np.asarray(lost, bool)
    _check(estimate.shape, lost.shape, truth)
    seen = np.asarray(truth.visible, bool)
    there, error = joint_errors_mm(estimate, truth)
    average, largest = error.mean(1), error.max(1)
    said = ~lost & there
    recent = seen.copy()
    for back in range(1, FORGIVEN_FRAMES + 1):
        recent[back:] |= seen[:-back]
    wrong = np.where(seen, average > OK_MM, ~recent)
    return Judged(
        seen=seen,
        there=there,
        said=said,
        usable=seen & said & (largest <= OK_MM),
        partly=seen & said & (average <= OK_MM) & (largest > OK_MM),
        false_alarm=seen & lost & there & (largest <= OK_MM),
        silent=said & wrong,
        error_mm=error,
        mean_mm=average,
    )


def joint_errors_mm(joints_m: np.ndarray, truth: Truth) -> tuple[np.ndarray, np.ndarray]:
    """Where (T, J, 3) estimates are, (T,) bool, and the (T, J) distances to the true joints: the
    one place that says what an error is. Estimates that are not finite are a kilometre away."""
    there = np.asarray(np.isfinite(joints_m).all((1, 2)))
    somewhere = np.where(there[:, None, None], joints_m, _NOWHERE_M)
    return there, 1e3 * np.linalg.norm(somewhere - truth.joints_m, axis=2)


def tips_inset(joints_m: np.ndarray, inset_m: float) -> np.ndarray:
    """Joints (T, 21, 3) with the fingertips, as labels have them, inwards along the last bone."""
    moved = np.array(joints_m, np.float64)
    for tip in TIPS:
        inwards = moved[:, tip - 1] - moved[:, tip]
        length = np.linalg.norm(inwards, axis=1, keepdims=True)
        moved[:, tip] += inset_m * inwards / np.maximum(length, 1e-9)
    return moved


def slots_of_hands(
    joints_m: np.ndarray, lost: np.ndarray, hands: Sequence[Truth]
) -> tuple[int, ...]:
    """The slot of each hand: one for the whole recording, so that the sum of errors is smallest; a
    swap on the way counts as error.

    joints_m: (T, S, J, 3) metres, camera frame, S not below the hands.  lost: (T, S) bool.
    Raises ToftrackError: as `judged`.
    """
    from scipy.optimize import linear_sum_assignment  # a fifth of a second, which few runs need

    estimate, lost = np.asarray(joints_m, np.float64), np.asarray(lost, bool)
    for hand in hands:
        _check(estimate[:, 0].shape, lost[:, 0].shape, hand)
    slots = range(estimate.shape[1])
    costs = [[_cost(estimate[:, slot], lost[:, slot], hand) for slot in slots] for hand in hands]
    return tuple(linear_sum_assignment(costs)[1].tolist())


def steady(flags: np.ndarray, cut: bool = False) -> np.ndarray:
    """(T,) bool: RIGHT_FRAMES from there on (with `cut`, fewer at the recording's end) are true."""
    longer = np.concatenate([flags, np.full(RIGHT_FRAMES - 1, cut)])
    shifted = [longer[i : i + len(flags)] for i in range(RIGHT_FRAMES)]
    return np.asarray(np.all(shifted, axis=0))


def until(flags: np.ndarray, frame: int) -> int | None:
    """Frames from `frame` to the first true one; None: there is none."""
    later = np.flatnonzero(flags[frame:])
    return int(later[0]) if len(later) else None


def longest_run(flags: np.ndarray) -> int:
    """The number of frames of the longest run of true ones in (T,) bool."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _check(estimate: tuple[int, ...], lost: tuple[int, ...], hand: Truth) -> None:
    true, visible = np.shape(hand.joints_m), np.shape(hand.visible)
    if len(true) != 3 or estimate != true or lost != true[:1] or visible != true[:1]:
        raise ToftrackError(
            f"the estimates have the shape {estimate} and 'lost' {lost}, but the truth has {true} "
            f"and 'visible' {visible}; compare the same joints of the same frames"
        )


def _cost(estimate: np.ndarray, lost: np.ndarray, hand: Truth) -> float:
    """Metres: what it costs to give a slot's (T, J, 3) and (T,) to a hand."""
    error = 1e-3 * joint_errors_mm(estimate, hand)[1].mean(1)
    counted = np.minimum(np.where(lost, np.inf, error), _MISS_M)
    return float(np.where(hand.visible, counted, 0.0).sum())
