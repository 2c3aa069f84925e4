"""Which detection is of which track, which ones begin tracks, and which tracks end.

Multi-object tracking by detection as in SORT (Bewley et al., ICIP 2016): predicted places and
detections are assigned to each other so that the sum of all costs is least; what is left over
begins tentative tracks, and tracks that nobody sees end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from toftrack.detector.hand_detector import Detection, merit
from toftrack.detector.proposals import SAME_PLACE_M
from toftrack.tracking.filter import PredictedHand
from toftrack.tracking.posterior import touching
from toftrack.tracking.state import Track

_STEP_M, _SPEED_M_S = 0.04, 0.25
"""Standard deviation of where a hand is that was believed in the last frame, and what it grows by
in a second."""
_GATE = 3.5
"""Standard deviations from which on a detection is no track's."""
_SAME_PALM_M, _SAME_HAND_M, _SAME_JOINTS = 0.022, 0.045, 0.3
"""Two hands are one where the middles of their palms are nearer than a palm is thick; or so near,
and so much of one lies in the other."""
_IMPOSSIBLE = 1e6
"""Cost beyond the gate."""
_TENTATIVE_S = 0.5
"""A tentative track beside a confirmed one ends when it was not confirmed for so long."""


@dataclass(frozen=True, eq=False)
class SideDetection:
    """A detection as a hand of a side.

    row: of the track at whose place it was; -1 = a place of the finder.
    mirrored: what is seen there as a hand of the other side, where both are to be compared.
    """

    detection: Detection
    side: str
    row: int = -1
    mirrored: Detection | None = None


def costs(hands: Sequence[PredictedHand], seen: Sequence[SideDetection], dt_s: float) -> np.ndarray:
    """(B, D) minus the log likelihood of each detection as each track's hand; inf where it is none.

    It is half the squared distance of the palms in standard deviations, less what speaks for a hand
    there. What was seen at a track's place is no other's, nor is a hand of the other side.
    """
    cost = np.full((len(hands), len(seen)), math.inf)
    for row, hand in enumerate(hands):
        sigma = _STEP_M + _SPEED_M_S * (hand.track.believed_s + dt_s)
        for column, one in enumerate(seen):
            away = float(np.linalg.norm(one.detection.centre_m.numpy() - hand.palm_m[0])) / sigma
            if one.row == row or (one.row < 0 and one.side == hand.track.side and away < _GATE):
                cost[row, column] = 0.5 * away**2 - merit(one.detection, one.detection.heat)
    return cost


def assign(cost: np.ndarray) -> list[int]:
    """(B, D) costs to the column of each row, -1 where it has none: as many rows as possible have
    one, and the sum of their costs is least.
    """
    rows, columns = cost.shape
    whole = np.full((rows, columns + rows), 0.5 * _IMPOSSIBLE)  # each may go without
    whole[:, :columns] = np.where(np.isfinite(cost), cost, _IMPOSSIBLE)
    found = linear_sum_assignment(whole)[1]
    return [int(column) if column < columns else -1 for column in found]


def same_hand(
    first_m: np.ndarray, second_m: np.ndarray, first: torch.Tensor, second: torch.Tensor
) -> bool:
    """Whether two hands are one.  first_m, second_m: (3,) palms.  first, second: (21, 3) joints."""
    apart = float(np.linalg.norm(first_m - second_m))
    if apart > _SAME_HAND_M:
        return False
    return apart < _SAME_PALM_M or float(touching(first[None], second)) > _SAME_JOINTS


def unassigned(seen: Sequence[SideDetection], taken: Sequence[int]) -> list[SideDetection]:
    """The detections at places of the finder that are no track's, each hand once."""
    explained = [seen[column] for column in taken if column >= 0]
    new = [one for column, one in enumerate(seen) if one.row < 0 and column not in taken]
    found: list[SideDetection] = []
    for one in new:
        if not any(_same(one, other) for other in [*explained, *found]):
            found.append(one)
    return found


def _same(first: SideDetection, second: SideDetection) -> bool:
    """Whether two detections are of one hand; two hands of one side are never close to another."""
    palms = [one.detection.centre_m.numpy() for one in (first, second)]
    if first.side == second.side and np.linalg.norm(palms[0] - palms[1]) < SAME_PLACE_M:
        return True
    joints = [one.detection.keypoints.points_m for one in (first, second)]
    return same_hand(palms[0], palms[1], joints[0], joints[1])


def track_ends(track: Track, confirmed_beside: bool, patience: int) -> bool:
    """Whether a track ends: nobody sees its hand any more, or it is none."""
    if patience and track.doubtful.begun and track.doubtful.reached(patience):
        return True
    return not track.confirmed and confirmed_beside and track.age.seconds > _TENTATIVE_S


def sureness(track: Track) -> float:
    """How surely a track is of a hand: one that was confirmed comes before one that was not."""
    return track.log_odds + 20.0 * track.confirmed
