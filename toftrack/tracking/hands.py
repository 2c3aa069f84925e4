"""One or two hands: a state each, in slots that keep to their hand."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from toftrack.checks import check_number
from toftrack.compute.pace import elapsed_s
from toftrack.compute.threads import at_most, small_operations
from toftrack.errors import ToftrackError
from toftrack.estimate import Estimate, no_estimate
from toftrack.frames import DepthImage, checked_image
from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import hand_surface
from toftrack.pose_space.base import PoseSpace
from toftrack.render.closed_form import render_range_images
from toftrack.render.scoring import Scorer
from toftrack.render.segmentation import reduce_image
from toftrack.tracking.handedness_estimate import OTHER_SIDE
from toftrack.tracking.model import FilterModel, TrackerModel
from toftrack.tracking.quality import Pace, Timekeeper
from toftrack.tracking.slots import (
    believed,
    exchanged,
    in_wrong_slot,
    known_side,
    of_one_hand,
    partnered,
    placed,
    seen_beside,
    sureness,
)
from toftrack.tracking.state import StepInfo, TrackerState
from toftrack.tracking.step import step
from toftrack.tracking.tracker import restarted, stepped

_SOUGHT_S = 0.12
"""How often a further hand is looked for."""
_TRIED_S, _AGAIN_S = 0.5, 0.5
"""A second track is given up when it was not believed for so long, and looked for so much later."""
_ONE_S = 0.15
"""Two tracks that were believed may be on one hand for so long."""
_RENDERED_PX = 72, 88
"""Size of an image that nobody sees."""


@dataclass(frozen=True, eq=False)
class HandsState:
    """All that is carried between frames.

    slots: of each hand.  unsought_s: how long ago a further hand was looked for.
    one_s: how long two tracks have seemed to be of one hand.
    """

    slots: tuple[TrackerState, ...]
    second_search_age_s: float = math.inf
    one_s: float = 0.0


def first_states(model: FilterModel, seed: int, hands: int) -> HandsState:
    """Before any frame. The second slot looks for the other side of the first one."""
    first, *others = (model.first_state(seed + slot) for slot in range(hands))
    return HandsState((first, *(replace(state, side=OTHER_SIDE[first.side]) for state in others)))


@small_operations()
def step_hands(
    state: HandsState, image: DepthImage, model: TrackerModel
) -> tuple[HandsState, tuple[StepInfo | None, ...], tuple[Estimate, ...]]:
    """One frame of two hands: the surer one first, and each knows of the other one.

    A pure function, as `step`. A vacant slot looks for a hand now and then.
    """
    slots, before = list(state.slots), state.slots
    dt_s = elapsed_s(slots[0].timestamp_s, image.timestamp_s)
    depth_m, k = reduce_image(image.depth_m, image.k, model.segmentation.max_pixels)
    size = (depth_m.shape[0], depth_m.shape[1])
    hands = [placed(slot, model, k, size, dt_s) for slot in slots]
    infos: list[StepInfo | None] = [None, None]
    reported: list[Estimate | None] = [None, None]
    second_search_age_s = state.second_search_age_s + dt_s
    vacant = [slot.track is None for slot in slots]
    sought = all(vacant) or second_search_age_s >= _SOUGHT_S
    for mine in sorted((0, 1), key=lambda slot: -sureness(slots[slot])):
        theirs = 1 - mine
        if vacant[mine] and not sought:
            slots[mine] = slots[mine].at(image)
            continue
        other = seen_beside(slots[theirs], hands[theirs], hands[mine], depth_m)
        partner = partnered(slots[mine], slots[theirs], model)
        slots[mine], infos[mine], reported[mine] = step(partner, image, model, other)
        hands[mine] = placed(slots[mine], model, k, size)
    second_search_age_s = 0.0 if sought else second_search_age_s
    one_s = state.one_s + dt_s if of_one_hand(hands) else 0.0
    if one_s and (one_s > _ONE_S or not all(believed(slot) for slot in slots)):
        worse = min((0, 1), key=lambda slot: sureness(slots[slot]))
        slots[worse], one_s = replace(slots[worse], track=None), 0.0
    for slot in (0, 1):
        if _in_vain(slots[slot], slots[1 - slot]):
            second_search_age_s = 0.0 if known_side(slots[slot]) else -_AGAIN_S
            slots[slot] = replace(slots[slot], track=None)
    if in_wrong_slot(before, slots):
        slots = exchanged(before, slots)
        infos.reverse()
        reported.reverse()
    dims = model.space.dims
    nothing = no_estimate(image.index, image.timestamp_s, "lost", dims, math.nan)
    estimates = tuple(
        nothing if estimate is None or slot.track is None else estimate
        for slot, estimate in zip(slots, reported, strict=True)
    )
    return HandsState(tuple(slots), second_search_age_s, one_s), tuple(infos), estimates


def _in_vain(slot: TrackerState, other: TrackerState) -> bool:
    """Whether a second track was not believed for too long."""
    track = slot.track
    return track is not None and not track.believed and believed(other) and track.age_s > _TRIED_S


class HandsTracker:
    """Follows `hands` hands, each in a slot of its own: slot 0 is the first one that was found.

    state: all that is carried between frames; one that was kept may be put back.
    infos: what the last step saw and believed of each; None where it did not look.
    time: what frames take, and what may be spent on them.
    """

    def __init__(
        self,
        model: FilterModel,
        seed: int = 0,
        hands: int = 1,
        pace: Pace | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """pace, clock: see Tracker.

        Raises ToftrackError when `hands` is neither 1 nor 2, or 2 without networks.
        """
        check_number("hands", hands, 1, 2, whole=True)
        if hands > 1 and not isinstance(model, TrackerModel):
            raise ToftrackError(
                "hands=2 tells two hands apart by the networks, but experiment=paper has none;"
                " give hands=1, or leave experiment=paper out"
            )
        self.model, self.time = model, Timekeeper(pace, clock)
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
        began_s: float | None = None,
    ) -> tuple[Estimate, ...]:
        """One frame, see Tracker.step; an estimate a slot. One without a hand is lost and NaN."""
        quality = self.time.begin(began_s)
        depth_m, k = checked_image(depth_m, k)
        index = self.states[0].next_index if index is None else index
        timestamp_s = time.monotonic() if timestamp_s is None else timestamp_s
        image = DepthImage(depth_m, k, index, timestamp_s)
        model = self.model.at_quality(quality)
        with at_most(quality.threads):
            if len(self.states) == 2 and isinstance(model, TrackerModel):
                self.state, self.infos, estimates = step_hands(self.state, image, model)
            else:
                state, info, estimate = stepped(self.states[0], image, model)
                estimates = (estimate,)
                self.state, self.infos = HandsState((state,)), (info,)
        took_s = self.time.took_s()
        return tuple(replace(estimate, compute_s=took_s) for estimate in estimates)

    @small_operations()
    def prepare(self) -> None:
        """Load and compile now what the first frame would have to wait for; changes nothing."""
        stepped(self.states[0], _rendered_hand(), self.model)

    def restart(self, side: str | None = None) -> None:
        """Forget the hands, see Tracker.restart; a side is the first one's."""
        first, *others = self.states
        first = restarted(first, self.model, side)
        other = OTHER_SIDE[first.side]
        others = [restarted(state, self.model, side and other) for state in others]
        self.state = HandsState((first, *(replace(state, side=other) for state in others)))
        self.infos = (None,) * len(self.states)

    @property
    def shapes(self) -> tuple[HandShape, ...]:
        """The hand of each slot that the next frame is compared with."""
        return tuple(self.model.hand(state.side, state.size).shape for state in self.states)

    @property
    def fitted(self) -> tuple[HandShape, ...]:
        """The same hands, with how sure the fit is of them."""
        return tuple(self.model.fitted(state.side, state.size) for state in self.states)

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


def _rendered_hand() -> DepthImage:
    """A small image of an open hand before a wall."""
    shape, (height, width) = default_hand_shape(), _RENDERED_PX
    state = torch.zeros(1, 27)
    state[0, 1:3] = torch.tensor([0.08, 0.5])
    k = torch.tensor([[110.0, 0, width / 2], [0, 110.0, height / 2], [0, 0, 1]])
    hand = hand_surface(shape).pose(forward_kinematics(state, shape))
    depth = render_range_images(hand, k, height, width)[0]
    return DepthImage(torch.where(depth > 0, depth, 1.5).numpy(), k.double().numpy(), 0, 0.0)
