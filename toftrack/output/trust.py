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
from scipy.optimize import linear_sum_assignment

from toftrack.errors import ToftrackError

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
    """The figures of one track of one hand, see the head of this module. Shares in per cent."""

    frames: int
    visible: int
    """How many show the hand."""
    usable_pct: float
    partly_pct: float
    false_alarm_pct: float
    silent_pct: float
    longest_silent: int
    """Frames of the longest run of silently wrong ones."""
    mean_mm: float | None
    """Mean joint error over visible frames that are not flagged lost; None: there are none."""
    mean_all_mm: float | None
    """The same over all visible frames; one frame counts for at most a metre."""
    first_right: int | None
    """From which frame on the track is right for the first time; None: never."""
    found_after: tuple[int | None, ...]
    """For each time that the hand becomes visible again: frames until the track is right."""


@dataclass(frozen=True, eq=False)
class Hand:
    """The truth about one hand of a recording."""

    joints_m: np.ndarray
    """(T, J, 3) metres, camera frame."""
    visible: np.ndarray
    """(T,) bool."""


@dataclass(frozen=True, eq=False)
class Judged:
    """What each of T frames is, see the head of this module: (T,) bool, but for the errors."""

    seen: np.ndarray
    """The hand is visible."""
    said: np.ndarray
    """There is an estimate that is not flagged lost."""
    usable: np.ndarray
    partly: np.ndarray
    false_alarm: np.ndarray
    silent: np.ndarray
    error_mm: np.ndarray
    """(T, J) joint errors; of estimates that are not finite, those to a point a kilometre away."""
    mean_mm: np.ndarray
    """(T,) their means."""


@dataclass(frozen=True)
class Share:
    """A mean over recordings with its 90 % bootstrap interval, per cent."""

    mean: float
    low: float
    high: float


def trust(joints_m: np.ndarray, lost: np.ndarray, hand: Hand) -> Trust:
    """The figures of one track, unrounded.

    Args:
        joints_m: (T, J, 3) estimates in metres, camera frame; not finite where there is none.
        lost: (T,) bool.
        hand: the truth about the same T frames and J joints.

    Raises:
        ToftrackError: estimates and truth differ in shape.
    """
    return figures_of(judged(joints_m, lost, hand))


def figures_of(of: Judged) -> Trust:
    """The figures of a track whose frames were judged."""
    average, seen = of.mean_mm, of.seen
    right = _runs(seen & of.said & (average < RIGHT_MM), RIGHT_FRAMES)
    returns = np.flatnonzero(seen[1:] & ~seen[:-1]) + 1
    good = seen & of.said
    return Trust(
        frames=len(seen),
        visible=int(seen.sum()),
        usable_pct=_share_pct(of.usable, seen),
        partly_pct=_share_pct(of.partly, seen),
        false_alarm_pct=_share_pct(of.false_alarm, seen),
        silent_pct=100.0 * float(of.silent.sum()) / max(len(seen), 1),
        longest_silent=longest_run(of.silent),
        mean_mm=float(average[good].mean()) if good.any() else None,
        mean_all_mm=float(np.minimum(average[seen], MOST_MM).mean()) if seen.any() else None,
        first_right=_until(right, 0),
        found_after=tuple(_until(right, int(frame)) for frame in returns),
    )


def judged(joints_m: np.ndarray, lost: np.ndarray, hand: Hand) -> Judged:
    """What each frame of a track is; arguments and errors as of `trust`."""
    estimate, lost = np.asarray(joints_m, np.float64), np.asarray(lost, bool)
    _check(estimate.shape, lost.shape, hand)
    seen = np.asarray(hand.visible, bool)
    finite = np.asarray(np.isfinite(estimate).all((1, 2)))
    error = _errors_mm(estimate, finite, hand)
    average, largest = error.mean(1), error.max(1)
    said = ~lost & finite
    wrong = np.where(seen, average > OK_MM, ~lingering(seen, FORGIVEN_FRAMES))
    return Judged(
        seen=seen,
        said=said,
        usable=seen & said & (largest <= OK_MM),
        partly=seen & said & (average <= OK_MM) & (largest > OK_MM),
        false_alarm=seen & lost & finite & (largest <= OK_MM),
        silent=said & wrong,
        error_mm=error,
        mean_mm=average,
    )


def slots_of_hands(
    joints_m: np.ndarray, lost: np.ndarray, hands: Sequence[Hand]
) -> tuple[int, ...]:
    """The slot of each hand.

    Each true hand has one slot for the whole recording, so that the sum of errors is smallest; a
    swap on the way counts as error.

    Args:
        joints_m: (T, S, J, 3) metres, camera frame.
        lost: (T, S) bool.
        hands: at most S.

    Raises:
        ToftrackError: as `trust`, or there are no slots, or fewer than hands.
    """
    estimate, lost = np.asarray(joints_m, np.float64), np.asarray(lost, bool)
    fits = estimate.ndim == 4 and lost.shape == estimate.shape[:2]
    if not fits or estimate.shape[1] < len(hands):
        raise ToftrackError(
            f"a track of {len(hands)} hands must have joints of the shape (T, S, J, 3) and lost of "
            f"(T, S), S at least {len(hands)}, but they are {estimate.shape} and {lost.shape}"
        )
    for hand in hands:
        _check(estimate[:, 0].shape, lost[:, 0].shape, hand)
    slots = range(estimate.shape[1])
    costs = [[_cost(estimate[:, slot], lost[:, slot], hand) for slot in slots] for hand in hands]
    return tuple(linear_sum_assignment(costs)[1].tolist())


def interval(shares: Sequence[float], draws: int = 2000, seed: int = 0) -> Share:
    """The mean of a share over recordings, with the interval from resampling the recordings."""
    values = np.asarray(shares, np.float64)
    rng = np.random.default_rng(seed)
    low, high = np.percentile(rng.choice(values, (draws, len(values))).mean(1), (5, 95))
    return Share(mean=float(values.mean()), low=float(low), high=float(high))


def lingering(visible: np.ndarray, frames: int) -> np.ndarray:
    """(T,) bool: the hand is visible, or was at most so many frames ago."""
    recent = visible.copy()
    for back in range(1, frames + 1):
        recent[back:] |= visible[:-back]
    return recent


def longest_run(flags: np.ndarray) -> int:
    """The number of frames of the longest run of true ones in (T,) bool."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _check(estimate: tuple[int, ...], lost: tuple[int, ...], hand: Hand) -> None:
    true, visible = np.shape(hand.joints_m), np.shape(hand.visible)
    if len(true) != 3 or estimate != true or lost != true[:1] or visible != true[:1]:
        raise ToftrackError(
            f"the estimates have the shape {estimate} and 'lost' {lost}, but the truth has {true} "
            f"and 'visible' {visible}; compare the same joints of the same frames"
        )


def _errors_mm(estimate: np.ndarray, finite: np.ndarray, hand: Hand) -> np.ndarray:
    """(T, J) joint errors; estimates that are not finite are a kilometre away."""
    somewhere = np.where(finite[:, None, None], estimate, _NOWHERE_M)
    return 1e3 * np.linalg.norm(somewhere - hand.joints_m, axis=2)


def _cost(estimate: np.ndarray, lost: np.ndarray, hand: Hand) -> float:
    """Metres: what it costs to give a slot's (T, J, 3) and (T,) to a hand."""
    finite = np.isfinite(estimate).all((1, 2))
    error = 1e-3 * _errors_mm(estimate, finite, hand).mean(1)
    counted = np.minimum(np.where(lost, np.inf, error), _MISS_M)
    return float(np.where(hand.visible, counted, 0.0).sum())


def _runs(flags: np.ndarray, length: int) -> np.ndarray:
    """(T,) bool: the frame and those after it, `length` together, are all true."""
    steady = np.zeros(len(flags), bool)
    last = len(flags) - length + 1
    if last > 0:
        steady[:last] = np.lib.stride_tricks.sliding_window_view(flags, length).all(axis=1)
    return steady


def _until(steady: np.ndarray, frame: int) -> int | None:
    """Frames from `frame` to the first true one; None: there is none."""
    later = np.flatnonzero(steady[frame:])
    return int(later[0]) if len(later) else None


def _share_pct(part: np.ndarray, whole: np.ndarray) -> float:
    return 100.0 * float(part.sum()) / max(int(whole.sum()), 1)
