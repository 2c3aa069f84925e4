"""Two hands: what each has to know of the other one, and which slot a hand belongs to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.compute.rigid import pivot_offset
from toftrack.frames import DepthImage
from toftrack.render.model_image import cpu_surface, parted, range_image
from toftrack.render.segmentation import reduce_image
from toftrack.tracking.filter import predicted_motion
from toftrack.tracking.model import FittedHand, TrackerModel
from toftrack.tracking.posterior import touching
from toftrack.tracking.state import HandState, Track

_TOLERANCE_M = 0.02
"""A pixel that is so near to a hand's surface may be the hand's."""
_EDGE_M = 0.06
"""Pixels on the outline of a hand mix it with what is behind, up to this."""
_FAR_M = 5.0
"""So far away is nothing for the detector."""
_IN_FRONT_M = 0.03
"""What is so much nearer than a hand's wrist may hide the hand."""
_BELIEVED = 20.0
"""A hand that was believed once comes before one that never was, log odds."""
_KNOWN = 0.5
"""Log odds from which on a slot's side is known."""
ONE_HAND_M, _ONE = 0.045, 0.3
"""Two tracks are of one hand where their palms are so near, and so much of one is in the other."""
_SAME_PALM_M = 0.022
"""Or where the middles of their palms are nearer than a palm is thick."""


@dataclass(frozen=True, eq=False)
class OtherHand:
    """What one hand has to know of another one in a frame.

    joints_m: (21, 3).  centre_m: (3,) middle of its palm.
    believed: it is a hand, and not just a place that may be one.
    certain: its last estimate was not flagged, so that pixels are its own.
    pixels: (H, W) bool of the reduced image, those that it explains better.
    beside: (H, W) bool, those of them that cannot hide this hand.
    watched: nobody asked for it.
    """

    joints_m: Tensor
    centre_m: np.ndarray
    believed: bool
    certain: bool
    pixels: np.ndarray
    beside: np.ndarray
    watched: bool = False


@dataclass(frozen=True, eq=False)
class PlacedHand:
    """Where a hand is, or is predicted.

    pose: (1, 27).  k: (3, 3) and size: (H, W) of the reduced image.
    """

    pose: Tensor
    fitted: FittedHand
    k: np.ndarray
    size: tuple[int, int]

    @cached_property
    def surface_m(self) -> np.ndarray:
        """(H, W) Z of its surface, 0 = none."""
        if not bool(self.pose.isfinite().all()):
            return np.zeros(self.size, np.float32)
        posed = cpu_surface(self.fitted.shape).pose(self.fitted.refiner.pose(self.pose.cpu()))
        return range_image(parted(posed)[0], self.k, *self.size)

    @cached_property
    def joints_m(self) -> Tensor:
        """(21, 3) on the CPU."""
        return self.fitted.refiner.joints(self.pose)[0].cpu()

    @property
    def centre_m(self) -> np.ndarray:
        """(3,) middle of the palm."""
        hand = self.pose.numpy()
        centre: np.ndarray = hand[0, :3] + pivot_offset(hand[:, 3:6])[0]
        return centre


def placed(
    hand: HandState,
    track: Track,
    model: TrackerModel,
    k: np.ndarray,
    size: tuple[int, int],
    dt_s: float,
) -> PlacedHand:
    """A slot's hand as it is predicted dt_s after its last pose."""
    moved = predicted_motion(track, dt_s, model.filter)[None]
    shift = model.backend.motions.compose(track.mean, moved)[:, :3] - track.mean[:, :3]
    pose = torch.cat((track.pose[:, :3] + shift, track.pose[:, 3:]), 1)
    return PlacedHand(pose, model.hand(hand.side, hand.shape), k, size)


@dataclass(frozen=True, eq=False)
class Neighbour:
    """Another hand as a frame begins, before the image was looked at; see OtherHand.

    theirs: where it is.  mine: where this hand is, None where it has no place yet.
    """

    theirs: PlacedHand
    mine: PlacedHand | None
    believed: bool
    certain: bool
    watched: bool

    def seen(self, depth_m: np.ndarray) -> OtherHand:
        """It in the reduced image (H, W)."""
        theirs, mine = self.theirs, self.mine
        pixels = beside = np.zeros(depth_m.shape, bool)
        if self.certain and mine is None:
            pixels = explained(depth_m, theirs.surface_m, np.zeros_like(depth_m))
        elif self.certain and mine is not None:
            pixels = explained(depth_m, theirs.surface_m, mine.surface_m)
            beside = pixels & (depth_m > float(mine.pose[0, 2]) - _IN_FRONT_M)
        known = self.believed, self.certain
        return OtherHand(theirs.joints_m, theirs.centre_m, *known, pixels, beside, self.watched)


def neighbours_of(
    hands: Sequence[HandState],
    slots: Sequence[int],
    image: DepthImage,
    model: TrackerModel,
    dt_s: float,
) -> list[tuple[Neighbour, ...]]:
    """For each of the slots that take part, the other hands as they are predicted in a frame."""
    if not any(hands[own - 1].track is not None for own in slots):
        return [() for _ in hands]
    depth_m, k = reduce_image(image.depth_m, image.k, model.segmentation.max_pixels)
    size = (depth_m.shape[0], depth_m.shape[1])
    there = [
        placed(hand, hand.track, model, k, size, dt_s) if hand.track is not None else None
        for hand in hands
    ]
    return [
        tuple(
            _neighbour(hands[slot], theirs, mine)
            for slot, theirs in enumerate(there)
            if theirs is not None and slot != own and own in slots
        )
        for own, mine in enumerate(there)
    ]


def _neighbour(hand: HandState, theirs: PlacedHand, mine: PlacedHand | None) -> Neighbour:
    track = hand.track
    assert track is not None
    certain = track.believed and not track.doubted
    return Neighbour(theirs, mine, track.believed, certain, hand.watched)


def seen_in(
    neighbours: Sequence[Neighbour], image: DepthImage, model: TrackerModel
) -> tuple[OtherHand, ...]:
    """Other hands in an image."""
    if not neighbours:
        return ()
    depth_m, _ = reduce_image(image.depth_m, image.k, model.segmentation.max_pixels)
    return tuple(neighbour.seen(depth_m) for neighbour in neighbours)


def explained(depth_m: np.ndarray, theirs_m: np.ndarray, mine_m: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels of an image that the other hand's surface explains, and better than mine.

    depth_m, theirs_m, mine_m: (H, W) Z, 0 = none.
    """
    found = np.zeros(depth_m.shape, bool)
    rows, columns = (np.flatnonzero((theirs_m > 0).any(axis)) for axis in (1, 0))
    if not len(rows):
        return found
    # Within its own box, and a pixel around: most of the image is far from it.
    box = (
        slice(max(rows[0] - 1, 0), rows[-1] + 2),
        slice(max(columns[0] - 1, 0), columns[-1] + 2),
    )
    depth_m, theirs_m, mine_m = depth_m[box], theirs_m[box], mine_m[box]
    there = (depth_m > 0) & (theirs_m > 0)
    off = np.where(there, np.abs(depth_m - theirs_m), np.inf)
    my_off = np.where(mine_m > 0, np.abs(depth_m - mine_m), np.inf)
    sure = there & (off < my_off) & (off < _TOLERANCE_M)
    # About them lie the mixed pixels of its outline, which are neither hand's.
    near = cv2.dilate(sure.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    around = cv2.dilate(np.where(sure, theirs_m, np.float32(0)), np.ones((3, 3), np.float32))
    mixed = near & ~sure & (depth_m > around) & (depth_m < around + _EDGE_M)
    found[box] = sure | (mixed & (my_off >= _TOLERANCE_M))
    return found


def pixels_of(others: Sequence[OtherHand]) -> np.ndarray | None:
    """(H, W) bool of the reduced image: pixels of other hands; None where none are known."""
    masks = [other.pixels for other in others if other.certain]
    return np.logical_or.reduce(masks) if masks else None


def without(image: DepthImage, others: Sequence[OtherHand], wholly: bool = False) -> DepthImage:
    """The image as the detector is to see it: with nothing where other hands are, or its keypoints
    lie on their fingers as well. What may hide a hand stays, for it knows things that hide hands,
    unless the others are to be gone wholly.
    """
    for other in others:
        pixels = other.pixels if wholly else other.beside
        if pixels.any():
            height, width = image.depth_m.shape
            mask = pixels.view(np.uint8)
            gone = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
            image = replace(image, depth_m=np.where(gone, np.float32(_FAR_M), image.depth_m))
    return image


def partnered(hands: Sequence[HandState], model: TrackerModel) -> list[HandState]:
    """The hands, with what the other hand's side says of each one's."""
    settings = model.configured.handedness
    return [
        replace(hand, handedness=hand.handedness.beside(other.handedness, settings))
        if other.believed
        else replace(hand, handedness=hand.handedness.alone(settings))
        for hand, other in zip(hands, reversed(hands), strict=True)
    ]


def sureness(hand: HandState) -> float:
    """How surely a slot's last estimate was right."""
    if hand.track is None:
        return -math.inf
    return hand.track.log_odds + (_BELIEVED if hand.track.believed else 0.0)


def on_one_hand(first: PlacedHand, second: PlacedHand) -> bool:
    """Whether two tracks have come onto one hand."""
    apart = float(np.linalg.norm(first.centre_m - second.centre_m))
    if apart < _SAME_PALM_M:
        return True
    if apart > ONE_HAND_M:
        return False
    return float(touching(first.joints_m[None], second.joints_m)) > _ONE


def known_side(hand: HandState) -> str:
    """Of the hand that a slot had; "" where it had none, or nothing was said of its side."""
    known = hand.handedness.given or abs(hand.handedness.log_odds) > _KNOWN
    return hand.side if known and not hand.last.lost else ""


def in_wrong_slot(before: Sequence[HandState], hands: Sequence[HandState]) -> bool:
    """Whether a hand that began where both slots were vacant belongs into the other one.

    A slot keeps to a hand, also when both were away: whose it is tells which one came back. One
    that nobody knows comes into the first slot; but where a side is given, that is the first
    slot's, and a hand of the other side does not come into it.
    """
    began = [hand.track is not None for hand in hands]
    if any(hand.track is not None for hand in before) or sum(began) != 1:
        return False
    new = began.index(True)
    side = hands[new].side
    if before[0].handedness.given:
        return new != (0 if side == before[0].side else 1)
    known = [known_side(hand) for hand in before]
    first = 0 if known[0] == side or known[1] != side else 1
    return new != first


def exchanged(before: Sequence[HandState], hands: Sequence[HandState]) -> list[HandState]:
    """The new hand in the other slot; the one that it began in is as it was."""
    new = [hand.track is not None for hand in hands].index(True)
    now = hands[1 - new]
    # What was learned of a hand's shape and gestures stays with the slot that the hand is in.
    moved = replace(hands[new], shape=now.shape, gesture=now.gesture, last=now.last)
    return [before[new], moved] if new == 0 else [moved, before[new]]
