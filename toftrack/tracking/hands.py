"""One or two hands: a state each, slots that keep to their hand, and who explains which pixels."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from toftrack.checks import check_number
from toftrack.compute.pace import elapsed_s
from toftrack.compute.threads import small_operations
from toftrack.estimate import Estimate, no_estimate
from toftrack.frames import DepthImage, checked_image
from toftrack.hand.shape import HandShape
from toftrack.pose_space.base import PoseSpace
from toftrack.render.scoring import Scorer
from toftrack.render.segmentation import reduce_image
from toftrack.tracking.following import displacement
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.other_hand import (
    OtherHand,
    explained,
    palm_centre_m,
    surface_m,
    touching,
)
from toftrack.tracking.side_belief import OTHER_SIDE, SideBelief
from toftrack.tracking.state import StepInfo, TrackerState
from toftrack.tracking.step import at, first_state, step
from toftrack.tracking.tracker import fitted_hand, restarted

_SOUGHT_S = 0.12
"""How often a further hand is looked for."""
_BELIEVED = 20.0
"""A hand that was believed once comes before one that never was, log odds."""
_TRIED_S, _AGAIN_S = 0.5, 0.5
"""A second track is given up when it was not believed for so long, and looked for so much later."""
_KNOWN = 0.5
"""Log odds from which on a slot's side is known."""
_IN_FRONT_M = 0.03
"""What is so much nearer than a hand's wrist may hide the hand."""
_ONE_M, _ONE = 0.045, 0.3
"""Two tracks are of one hand where their palms are so near, and so much of them is in each other
..."""
_ONE_S = 0.15
"""... for so long; a track that was never believed gives way at once."""


@dataclass(frozen=True, eq=False)
class HandsState:
    """All that is carried between frames.

    slots: of each hand.  unsought_s: how long ago a further hand was looked for.
    one_s: how long two tracks have seemed to be of one hand.
    """

    slots: tuple[TrackerState, ...]
    unsought_s: float = math.inf
    one_s: float = 0.0


def first_states(model: TrackerModel, seed: int, hands: int) -> HandsState:
    """Before any frame. The second slot looks for the other side of the first one."""
    first, *others = (first_state(model, seed + slot) for slot in range(hands))
    return HandsState((first, *(replace(state, side=OTHER_SIDE[first.side]) for state in others)))


@small_operations()
def step_hands(
    state: HandsState, image: DepthImage, model: TrackerModel
) -> tuple[HandsState, tuple[StepInfo | None, ...], tuple[Estimate, ...]]:
    """One frame of two hands: the surer one first, and each knows of the other one."""
    slots, before = list(state.slots), state.slots
    dt_s = elapsed_s(slots[0].timestamp_s, image.timestamp_s)
    depth_m, k = reduce_image(image.depth_m, image.k, model.segmentation.max_pixels)
    poses = [_expected_pose(slot, dt_s, model) for slot in slots]
    infos: list[StepInfo | None] = [None] * len(slots)
    estimates: list[Estimate | None] = [None] * len(slots)
    unsought_s = state.unsought_s + dt_s
    vacant = [slot.track is None for slot in slots]
    sought = all(vacant) or unsought_s >= _SOUGHT_S
    for slot in sorted(range(len(slots)), key=lambda slot: _sureness(slots[slot]), reverse=True):
        if vacant[slot] and not sought:
            slots[slot] = at(slots[slot], image)
            continue
        other = _other_hand(slots, poses, slot, depth_m, k, model)
        slots[slot] = _beside(slots, slot, model)
        slots[slot], infos[slot], estimates[slot] = step(slots[slot], image, model, other)
        track = slots[slot].track
        poses[slot] = None if track is None else track.pose
    one_s = state.one_s + dt_s if _one_hand(slots, model) else 0.0
    if one_s and (one_s > _ONE_S or not all(_believed(slot) for slot in slots)):
        worse = min(range(len(slots)), key=lambda slot: _sureness(slots[slot]))
        slots[worse], estimates[worse], one_s = replace(slots[worse], track=None), None, 0.0
    for slot, state_now in enumerate(slots):
        track = state_now.track
        alone = not _believed(slots[1 - slot])
        if track is not None and not track.believed and not alone and track.age_s > _TRIED_S:
            slots[slot], estimates[slot] = replace(state_now, track=None), None
            if _known_side(state_now) is None:
                unsought_s, sought = -_AGAIN_S, False
    if _in_wrong_slot(before, slots):
        slots = _exchanged(before, slots)
        infos.reverse()
        estimates.reverse()
    told = tuple(
        estimate if estimate is not None and slot.track is not None else _vacant(slot, image, model)
        for slot, estimate in zip(slots, estimates, strict=True)
    )
    return HandsState(tuple(slots), 0.0 if sought else unsought_s, one_s), tuple(infos), told


def _expected_pose(slot: TrackerState, dt_s: float, model: TrackerModel) -> Tensor | None:
    """(1, 27) where a slot's hand should be in this frame; None where there is none."""
    track = slot.track
    if track is None or track.pose is None:
        return None
    ahead = displacement(track, dt_s, model.filter)[None]
    motions = model.backend.motions
    moved = motions.compose(track.mean, ahead) - track.mean
    return torch.cat((track.pose[:, :3] + moved[:, :3], track.pose[:, 3:]), 1)


def _sureness(slot: TrackerState) -> float:
    """What slots are sorted by: how surely the last estimate was right."""
    if slot.track is None:
        return -math.inf
    log_odds = slot.track.log_odds
    return (log_odds or 0.0) + (_BELIEVED if slot.track.believed else 0.0)


def _believed(slot: TrackerState) -> bool:
    """Whether a slot has a hand, and not just a place that may be one."""
    return slot.track is not None and slot.track.believed


def _other_hand(
    slots: list[TrackerState],
    poses: list[Tensor | None],
    slot: int,
    depth_m: np.ndarray,
    k: np.ndarray,
    model: TrackerModel,
) -> OtherHand | None:
    """What a slot has to know of the other one's hand; only one that is believed takes pixels."""
    theirs, other = poses[1 - slot], slots[1 - slot]
    if theirs is None or other.track is None:
        return None
    hand, own, mine = model.hand(other.side, other.size), slots[slot], poses[slot]
    joints, centre = hand.refiner.joints(theirs)[0].cpu(), palm_centre_m(theirs)
    if other.track.doubted or not other.track.believed:
        return OtherHand(joints, centre, other.track.believed)
    height, width = depth_m.shape
    their_surface = surface_m(theirs, hand.shape, k, height, width)
    my_surface = None
    if mine is not None:
        shape = model.hand(own.side, own.size).shape
        my_surface = surface_m(mine, shape, k, height, width)
    pixels = explained(depth_m, their_surface, my_surface)
    beside = None if mine is None else pixels & (depth_m > float(mine[0, 2]) - _IN_FRONT_M)
    return OtherHand(joints, centre, True, pixels, beside)


def _beside(slots: list[TrackerState], slot: int, model: TrackerModel) -> TrackerState:
    """A slot's state, with what the other hand's side says of its own."""
    mine, theirs = slots[slot].sides, slots[1 - slot].sides
    if model.sides is None or mine is None or theirs is None:
        return slots[slot]
    known = theirs if _believed(slots[1 - slot]) else SideBelief()
    return replace(slots[slot], sides=mine.beside(known, model.sides))


def _one_hand(slots: list[TrackerState], model: TrackerModel) -> bool:
    """Whether both tracks have come onto one hand."""
    poses = [None if slot.track is None else slot.track.pose for slot in slots]
    if poses[0] is None or poses[1] is None:
        return False
    centres = [palm_centre_m(pose) for pose in poses if pose is not None]
    if float(np.linalg.norm(centres[0] - centres[1])) > _ONE_M:
        return False
    joints = [
        model.hand(slot.side, slot.size).refiner.joints(pose)
        for slot, pose in zip(slots, poses, strict=True)
        if pose is not None
    ]
    other = OtherHand(joints[1][0].cpu(), centres[1], False)
    return float(touching(joints[0], other)) > _ONE


def _in_wrong_slot(before: tuple[TrackerState, ...], slots: list[TrackerState]) -> bool:
    """Whether a hand that began where both slots were vacant belongs into the other one.

    A slot keeps to a hand, also when both were away: whose it is tells which one came back. One
    that nobody knows comes into the first slot.
    """
    began = [slot.track is not None for slot in slots]
    if any(slot.track is not None for slot in before) or sum(began) != 1:
        return False
    new = began.index(True)
    known = [_known_side(slot) for slot in before]
    side = slots[new].side
    first = 0 if known[0] == side or known[1] != side else 1
    return new != first


def _known_side(slot: TrackerState) -> str | None:
    """Of the hand that a slot had; None where it had none, or nothing was said of its side."""
    if slot.last is None or slot.last.lost:
        return None
    return slot.side if slot.sides is None or abs(slot.sides.log_odds) > _KNOWN else None


def _exchanged(before: tuple[TrackerState, ...], slots: list[TrackerState]) -> list[TrackerState]:
    """The new hand in the other slot; the one that it began in is as it was, at the time of now."""
    new = [slot.track is not None for slot in slots].index(True)
    now = slots[1 - new]
    waiting = replace(before[new], next_index=now.next_index, timestamp_s=now.timestamp_s)
    # What was learned of a hand's shape and gestures stays with the slot that the hand is in.
    moved = replace(slots[new], size=now.size, gesture=now.gesture, last=now.last)
    return [waiting, moved] if new == 0 else [moved, waiting]


def _vacant(slot: TrackerState, image: DepthImage, model: TrackerModel) -> Estimate:
    """The estimate of a slot without a hand: lost, and NaN."""
    return no_estimate(image.index, image.timestamp_s, "lost", model.space.dims, math.nan)


class HandsTracker:
    """Follows `hands` hands, each in a slot of its own: slot 0 is the first one that was found.

    state: all that is carried between frames; one that was kept may be put back.
    infos: what the last step saw and believed of each; None where it did not look.
    """

    def __init__(self, model: TrackerModel, seed: int = 0, hands: int = 1) -> None:
        """Raises ToftrackError when `hands` is neither 1 nor 2."""
        check_number("hands", hands, 1, 2, whole=True)
        self.model = model
        self.state = first_states(model, seed, hands)
        self.infos: tuple[StepInfo | None, ...] = (None,) * hands

    @property
    def states(self) -> tuple[TrackerState, ...]:
        """Of the slots."""
        return self.state.slots

    def step(
        self,
        depth_m: np.ndarray,
        k: np.ndarray,
        index: int | None = None,
        timestamp_s: float | None = None,
    ) -> tuple[Estimate, ...]:
        """One frame, see Tracker.step; an estimate a slot. One without a hand is lost and NaN."""
        began = time.perf_counter()
        depth_m, k = checked_image(depth_m, k)
        index = self.states[0].next_index if index is None else index
        timestamp_s = time.monotonic() if timestamp_s is None else timestamp_s
        image = DepthImage(depth_m, k, index, timestamp_s)
        if len(self.states) == 1:
            state, info, estimate = step(self.states[0], image, self.model)
            self.state, self.infos, estimates = HandsState((state,)), (info,), (estimate,)
        else:
            self.state, self.infos, estimates = step_hands(self.state, image, self.model)
        took = time.perf_counter() - began
        return tuple(replace(estimate, compute_s=took) for estimate in estimates)

    def restart(self, side: str | None = None) -> None:
        """Forget the hands, see Tracker.restart; a side is the first one's."""
        first, *others = self.states
        first = restarted(first, self.model, side)
        self.state = HandsState(
            (
                first,
                *(restarted(state, self.model, OTHER_SIDE[first.side]) for state in others),
            )
        )
        self.infos = (None,) * len(self.states)

    @property
    def shapes(self) -> tuple[HandShape, ...]:
        """The hand of each slot that the next frame is compared with."""
        return tuple(self.model.hand(state.side, state.size).shape for state in self.states)

    @property
    def fitted(self) -> tuple[HandShape, ...]:
        """The same hands, with how sure the fit is of them."""
        return tuple(fitted_hand(state, self.model) for state in self.states)

    @property
    def scorer(self) -> Scorer:
        """The back end's, for the first hand."""
        return self.model.hand(self.states[0].side, self.states[0].size).scorer

    @property
    def space(self) -> PoseSpace:
        """The pose space."""
        return self.model.space

    @property
    def device(self) -> torch.device:
        """Where everything is computed."""
        return self.model.device

    @property
    def insights(self) -> tuple[StepInfo | None, ...]:
        """What the last step saw and believed of each; None where nothing could be a hand."""
        return tuple(
            None if info is None or info.observation.empty else info for info in self.infos
        )
