"""Association of detections with tracks, new tracks, and the end of tracks.

Multi-object tracking by detection as in SORT (Bewley et al., ICIP 2016): predicted places and
detections are assigned to each other so that the sum of all costs is least; unassigned detections
begin tentative tracks, and tracks that stay doubtful end.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from toftrack.compute.compiling import entry_point
from toftrack.detector.detection import Detection
from toftrack.detector.proposals import SAME_PLACE_M
from toftrack.tracking.filter import PredictedHand, palm_of
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.posterior import touching
from toftrack.tracking.state import Track, TrackerState, changed

_STEP_M, _SPEED_M_S = 0.04, 0.25
"""Standard deviation of a predicted palm's place, and how fast it grows from the last believed
frame on."""
_GATE = 3.5
"""A detection at a place of the finder is not of a track that is more standard deviations away."""
_SAME_PALM_M, _SAME_HAND_M, _SAME_JOINTS = 0.022, 0.045, 0.3
"""Two hands are the same where their palms' middles are nearer than a palm is thick; or less near,
and more than this share of one lies in the other, see posterior.touching."""
_WITHOUT = 5e5
"""Cost of a track that gets no detection; an impossible pair costs twice as much."""
_TENTATIVE_S = 0.5
"""A tentative track beside a confirmed one ends at this age."""


@dataclass(frozen=True, eq=False)
class SideDetection:
    """A detection of a hand as one of `side`.

    row: of the track that was looked at; -1 = a place of the finder.
    mirrored: the detection there as a hand of the other side, where both are to be compared.
    """

    detection: Detection
    side: str
    row: int = -1
    mirrored: Detection | None = None


def costs(hands: Sequence[PredictedHand], seen: Sequence[SideDetection], dt_s: float) -> np.ndarray:
    """(B, D) cost of each detection for each of B tracks: half the squared distance of their palms
    in standard deviations, less the detection's merit; inf where it cannot be the track's.

    A detection made at a track is no other's; one of the finder needs the track's side and gate.
    """
    cost = np.full((len(hands), len(seen)), math.inf)
    for row, hand in enumerate(hands):
        sigma = _STEP_M + _SPEED_M_S * (hand.track.believed_s + dt_s)
        for column, one in enumerate(seen):
            if one.row != row and (one.row >= 0 or one.side != hand.track.side):
                continue
            away = float(np.linalg.norm(one.detection.centre_m.numpy() - hand.palm_m)) / sigma
            if one.row == row or away < _GATE:
                cost[row, column] = 0.5 * away**2 - one.detection.merit
    return cost


def associate(
    hands: Sequence[PredictedHand], seen: Sequence[SideDetection], dt_s: float
) -> tuple[list[SideDetection | None], list[SideDetection]]:
    """The detection of each track's hand, None where it has none; and the detections that may begin
    a track.
    """
    columns = assign(costs(hands, seen, dt_s))
    return [seen[at] if at >= 0 else None for at in columns], unassigned(seen, columns)


def assign(cost: np.ndarray) -> list[int]:
    """The column of each row of (B, D) costs, -1 where it has none: as many rows as possible have
    one, and the sum of their costs is least.
    """
    rows, columns = cost.shape
    whole = np.full((rows, columns + rows), _WITHOUT)
    whole[:, :columns] = np.where(np.isfinite(cost), cost, 2 * _WITHOUT)
    return [column if column < columns else -1 for column in least_cost(whole)]


def least_cost(cost: np.ndarray) -> list[int]:
    """The column of each row of (B, C >= B) finite costs, each its own, so that their sum is least.

    The Hungarian method (Kuhn, Naval Res. Logist. Q. 2, 1955): row by row, along the shortest path
    of exchanges, by costs that are reduced by what rows and columns are worth.
    """
    found = np.empty(len(cost), np.int64)
    _assign_rows(cost, found)
    at: list[int] = found.tolist()
    return at


@entry_point
def _assign_rows(cost, found):
    """See least_cost; found: (B,), written."""
    rows, columns = cost.shape
    row_worth, column_worth = np.zeros(rows), np.zeros(columns + 1)
    away, before = np.empty(columns), np.empty(columns, np.int64)
    done, row_of = np.empty(columns + 1, np.bool_), np.empty(columns + 1, np.int64)
    for column in range(columns + 1):
        row_of[column] = -1
    for row in range(rows):
        column, row_of[columns] = columns, row  # the last column stands for that of this row
        for other in range(columns + 1):
            done[other] = False
        for other in range(columns):
            away[other], before[other] = np.inf, columns
        while row_of[column] >= 0:
            done[column] = True
            at, nearest, step = row_of[column], -1, np.inf
            for other in range(columns):
                if done[other]:
                    continue
                reduced = cost[at, other] - row_worth[at] - column_worth[other]
                if reduced < away[other]:
                    away[other], before[other] = reduced, column
                if nearest < 0 or away[other] < step:  # some column also where a cost is no number
                    nearest, step = other, away[other]
            for other in range(columns + 1):
                if done[other]:
                    row_worth[row_of[other]] += step
                    column_worth[other] -= step
                elif other < columns:
                    away[other] -= step
            column = nearest
        while column != columns:
            row_of[column], column = row_of[before[column]], before[column]
    for column in range(columns):
        if row_of[column] >= 0:
            found[row_of[column]] = column


def unassigned(seen: Sequence[SideDetection], taken: Sequence[int]) -> list[SideDetection]:
    """The detections at the finder's places that are of no track's hand, one for each hand.

    taken: the index of the detection of each track, -1 = none, see assign.
    """
    explained = [seen[column] for column in taken if column >= 0]
    new = [one for column, one in enumerate(seen) if one.row < 0 and column not in taken]
    found: list[SideDetection] = []
    for one in new:
        if not any(_same(one, other) for other in [*explained, *found]):
            found.append(one)
    return found


def _same(first: SideDetection, second: SideDetection) -> bool:
    """Whether two detections are of the same hand; those of one side at one place always are."""
    palms = [one.detection.centre_m.numpy() for one in (first, second)]
    apart = float(np.linalg.norm(palms[0] - palms[1]))
    if first.side == second.side and apart < SAME_PLACE_M:
        return True
    return same_hand(apart, *(one.detection.keypoints.points_m for one in (first, second)))


def same_hand(apart_m: float, first: Tensor, second: Tensor) -> bool:
    """Whether two sets of joints (21, 3), whose palms are apart_m apart, are of the same hand."""
    if apart_m > _SAME_HAND_M:
        return False
    return apart_m < _SAME_PALM_M or float(touching(first[None], second)) > _SAME_JOINTS


def track_ends(track: Track, confirmed_beside: bool, patience: int) -> bool:
    """Whether a track ends: because it was doubtful for `patience` frames (0 = never), or tentative
    for too long beside a confirmed one.
    """
    if patience and track.doubtful.reached(patience):
        return True
    return not track.confirmed and confirmed_beside and track.age.seconds > _TENTATIVE_S


def keep_tracks(state: TrackerState, tracks: Sequence[Track], model: TrackerModel) -> TrackerState:
    """The state with those of the tracks that go on; of tracks on one hand, the surest."""
    confirmed = sum(track.confirmed for track in tracks)
    ended = {
        track.number
        for track in tracks
        if track_ends(track, confirmed > track.confirmed, model.lost.patience)
    }
    hands = [model.hand(track.side, track.shape) for track in tracks]
    palms = [palm_of(track.pose, hand)[0] for track, hand in zip(tracks, hands, strict=True)]
    # Any confirmed track is surer than any tentative one.
    sureness = [track.log_odds + 20.0 * track.confirmed for track in tracks]
    surest = sorted(range(len(tracks)), key=lambda row: sureness[row], reverse=True)
    for first, second in itertools.combinations(surest, 2):
        if ended & {tracks[first].number, tracks[second].number}:
            continue
        apart = float(np.linalg.norm(palms[first] - palms[second]))
        if apart < _SAME_HAND_M:
            joints = (hands[row].refiner.joints(tracks[row].pose)[0] for row in (first, second))
            if same_hand(apart, *joints):
                ended.add(tracks[second].number)
    kept = [track for track in tracks if track.number not in ended]
    return changed(state, tracks=tuple(sorted(kept, key=lambda track: track.number)))
