"""Two slots, each with a hand: which one a hand belongs to, and what each knows of the other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from toftrack.render.model_image import model_range_image
from toftrack.tracking.following import displacement
from toftrack.tracking.handedness_estimate import HandednessEstimate
from toftrack.tracking.model import SizedHand, TrackerModel
from toftrack.tracking.other_hand import OtherHand, explained, palm_centre_m, touching
from toftrack.tracking.state import TrackerState

_BELIEVED = 20.0
"""A hand that was believed once comes before one that never was, log odds."""
_KNOWN = 0.5
"""Log odds from which on a slot's side is known."""
_IN_FRONT_M = 0.03
"""What is so much nearer than a hand's wrist may hide the hand."""
_ONE_M, _ONE = 0.045, 0.3
"""Two tracks are of one hand where their palms are so near, and so much of one is in the other."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Where a slot's hand is, or should be, in a frame.

    pose: (1, 27).  k: (3, 3) and size: (H, W) of the reduced image.
    """

    pose: Tensor
    hand: SizedHand
    k: np.ndarray
    size: tuple[int, int]

    @cached_property
    def surface_m(self) -> np.ndarray:
        """(H, W) Z of its surface, 0 = none."""
        return model_range_image(self.pose[0].cpu().numpy(), self.hand.shape, self.k, *self.size)

    @cached_property
    def joints_m(self) -> Tensor:
        """(21, 3)."""
        return self.hand.refiner.joints(self.pose)[0]


def placed(
    slot: TrackerState, model: TrackerModel, k: np.ndarray, size: tuple[int, int], dt_s: float = 0.0
) -> Placed | None:
    """A slot's hand dt_s after its last pose; None where there is none."""
    track = slot.track
    if track is None:
        return None
    pose = track.pose
    if dt_s > 0:
        predicted = displacement(track, dt_s, model.filter)[None]
        moved = model.backend.motions.compose(track.mean, predicted) - track.mean
        pose = torch.cat((pose[:, :3] + moved[:, :3], pose[:, 3:]), 1)
    return Placed(pose, model.hand(slot.side, slot.size), k, size)


def sureness(slot: TrackerState) -> float:
    """What slots are sorted by: how surely the last estimate was right."""
    if slot.track is None:
        return -math.inf
    return (slot.track.log_odds or 0.0) + (_BELIEVED if slot.track.believed else 0.0)


def believed(slot: TrackerState) -> bool:
    """Whether a slot has a hand, and not just a place that may be one."""
    return slot.track is not None and slot.track.believed


def seen_beside(
    other: TrackerState, theirs: Placed | None, mine: Placed | None, depth_m: np.ndarray
) -> OtherHand | None:
    """What a slot has to know of the other one's hand; only one that is believed takes pixels."""
    if theirs is None or other.track is None:
        return None
    joints, centre = theirs.joints_m.cpu(), palm_centre_m(theirs.pose)
    if other.track.doubted or not other.track.believed:
        return OtherHand(joints, centre, other.track.believed)
    pixels = explained(depth_m, theirs.surface_m, None if mine is None else mine.surface_m)
    beside = None
    if mine is not None:
        beside = pixels & (depth_m > float(mine.pose[0, 2]) - _IN_FRONT_M)
    return OtherHand(joints, centre, True, pixels, beside)


def partnered(slot: TrackerState, other: TrackerState, model: TrackerModel) -> TrackerState:
    """A slot's state, with what the other hand's side says of its own."""
    if model.sides is None or slot.sides is None or other.sides is None:
        return slot
    known = other.sides if believed(other) else HandednessEstimate()
    return replace(slot, sides=slot.sides.beside(known, model.sides))


def of_one_hand(hands: Sequence[Placed | None]) -> bool:
    """Whether two tracks have come onto one hand."""
    first, second = hands
    if first is None or second is None:
        return False
    centres = palm_centre_m(first.pose), palm_centre_m(second.pose)
    if float(np.linalg.norm(centres[0] - centres[1])) > _ONE_M:
        return False
    other = OtherHand(second.joints_m.cpu(), centres[1], False)
    return float(touching(first.joints_m[None], other)) > _ONE


def in_wrong_slot(before: Sequence[TrackerState], slots: Sequence[TrackerState]) -> bool:
    """Whether a hand that began where both slots were vacant belongs into the other one.

    A slot keeps to a hand, also when both were away: whose it is tells which one came back. One
    that nobody knows comes into the first slot.
    """
    began = [slot.track is not None for slot in slots]
    if any(slot.track is not None for slot in before) or sum(began) != 1:
        return False
    new = began.index(True)
    known = [known_side(slot) for slot in before]
    side = slots[new].side
    first = 0 if known[0] == side or known[1] != side else 1
    return new != first


def known_side(slot: TrackerState) -> str | None:
    """Of the hand that a slot had; None where it had none, or nothing was said of its side."""
    if slot.last is None or slot.last.lost:
        return None
    return slot.side if slot.sides is None or abs(slot.sides.log_odds) > _KNOWN else None


def exchanged(before: Sequence[TrackerState], slots: Sequence[TrackerState]) -> list[TrackerState]:
    """The new hand in the other slot; the one that it began in is as it was, at the time of now."""
    new = [slot.track is not None for slot in slots].index(True)
    now = slots[1 - new]
    waiting = replace(before[new], next_index=now.next_index, timestamp_s=now.timestamp_s)
    # What was learned of a hand's shape and gestures stays with the slot that the hand is in.
    moved = replace(slots[new], size=now.size, gesture=now.gesture, last=now.last)
    return [waiting, moved] if new == 0 else [moved, waiting]
