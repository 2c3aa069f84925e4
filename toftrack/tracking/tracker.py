"""The tracker: a frame in, an estimate of each hand out, a state held in between."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import cast

import numpy as np
import torch

from toftrack.compute.quality import Pace, Timekeeper
from toftrack.compute.threads import at_most, small_operations
from toftrack.errors import MOST_HANDS, ToftrackError, check_number
from toftrack.frames.estimate import Estimate
from toftrack.frames.frame import DepthImage, checked_image, checked_moment
from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.pose_space.base import PoseSpace
from toftrack.render.model_image import model_range_image
from toftrack.render.scoring import Scorer
from toftrack.tracking.model import FilterModel, TrackerModel
from toftrack.tracking.paper import PaperModel, paper_step
from toftrack.tracking.report import StepResult
from toftrack.tracking.state import OTHER_SIDE, Slot, StepInfo, Track, TrackerState
from toftrack.tracking.step import step

_RENDERED_PX = 72, 88
"""Size of an image that nobody sees."""


class HandsTracker:
    """Follows `hands` hands, each in a slot of its own. Slot 0 is the first one that was found, or,
    where a side was told, the hand of that side.

    state: all that is carried between frames; one that was kept may be put back.
    infos: what the last step saw and believed of each; None where it saw no hand.
    time: what frames take, and what may be spent on them.
    """

    def __init__(
        self, model: FilterModel, seed: int = 0, hands: int = 1, pace: Pace | None = None
    ) -> None:
        """pace: of a live device; None spends all effort on each frame.

        Raises ToftrackError when `hands` is no number of hands, or several without a detector.
        """
        check_number("hands", hands, 1, MOST_HANDS, whole=True)
        if hands > 1 and not model.detects:
            raise ToftrackError(
                f"hands={hands} needs networks to tell hands apart, and experiment=paper has none;"
                " give hands=1, or leave experiment=paper out"
            )
        self.model, self.time = model, Timekeeper(pace or Pace())
        self.state = model.first_state(seed, hands)
        self.infos: tuple[StepInfo | None, ...] = (None,) * hands

    def step(
        self,
        depth_m: np.ndarray,
        k: np.ndarray,
        index: int | None = None,
        timestamp_s: float | None = None,
        began_s: float | None = None,
    ) -> tuple[Estimate, ...]:
        """The estimate of each slot in a frame. A slot without a hand has a lost one.

        depth_m: (H, W) rectified Z in metres, 0 = no reading; H and W may change.
        k: (3, 3) intrinsics in pixels.
        index: number of the frame; None counts on from the last.
        timestamp_s: None is now, seconds on a clock that never goes back.
        began_s: time.perf_counter() when the raw frame was there, from which on compute_s counts;
            None is now.
        Raises ToftrackError when the image or k has the wrong shape, type or unit.
        """
        quality = self.time.begin(began_s)
        depth_m, k = checked_image(depth_m, k)
        index = self.state.next_index if index is None else index
        timestamp_s = time.perf_counter() if timestamp_s is None else timestamp_s
        image = DepthImage(depth_m, k, *checked_moment(index, timestamp_s))
        with at_most(quality.threads):
            model = self.model.at_quality(quality)
            self.state, self.infos, estimates = _step(self.state, image, model)
        of_frame = {"compute_s": self.time.took_s(), "image_size_px": depth_m.shape[::-1]}
        return tuple(estimate.updated(**_own(estimate), **of_frame) for estimate in estimates)

    @small_operations()
    def prepare(self) -> None:
        """Load and compile now what the first frame would have to wait for; changes nothing."""
        _step(self.state, _rendered_hand(), self.model)

    def restart(self, side: str | None = None) -> None:
        """Forget the hands, also their size, and search for them anew; only random numbers and
        frame numbers go on.

        side: right or left, which the first hand is told to be; auto, to detect it (the paper's
            tracker cannot, and treats it as None); None, as it was.
        Raises ToftrackError for an unknown side.
        """
        model, old = self.model, self.state
        if side is not None and side not in ("auto", *OTHER_SIDE):
            model.configured.shape.of_side(side)  # which says what it may be
        if side is None or (side == "auto" and not model.detects):
            side = old.told or ("auto" if model.detects else None)
        fresh = model.first_state(0, len(old.slots), side)
        self.state = replace(fresh, generator=old.generator, next_index=old.next_index)
        self.infos = (None,) * len(self.infos)

    @property
    def states(self) -> tuple[Slot, ...]:
        """The slots."""
        return self.state.slots

    @property
    def shapes(self) -> tuple[HandShape, ...]:
        """The hand of each slot that the next frame is compared with."""
        return tuple(self.model.hand(slot.side, slot.shape).shape for slot in self.states)

    @property
    def fitted(self) -> tuple[HandShape, ...]:
        """The same hands, with how sure the fit is of them."""
        return tuple(self.model.fitted(hand) for hand in self.states)

    @property
    def scorer(self) -> Scorer:
        """The back end's scorer of the first hand."""
        return self.model.hand(self.states[0].side, self.states[0].shape).scorer

    @property
    def space(self) -> PoseSpace:
        """The pose space."""
        return self.model.space

    @property
    def device(self) -> torch.device:
        """The particles' device; all else is on the CPU."""
        return self.model.device

    @property
    def insights(self) -> tuple[StepInfo | None, ...]:
        """The infos, but None where nothing could be a hand, as experiment=paper alone tells."""
        return tuple(
            None if info is None or info.observation.empty else info for info in self.infos
        )


class Tracker:
    """Follows one hand: the only slot of a HandsTracker, `hands`, which says more of each part."""

    def __init__(self, model: FilterModel, seed: int = 0, pace: Pace | None = None) -> None:
        self.hands = HandsTracker(model, seed, 1, pace)

    def step(
        self,
        depth_m: np.ndarray,
        k: np.ndarray,
        index: int | None = None,
        timestamp_s: float | None = None,
        began_s: float | None = None,
    ) -> Estimate:
        """One frame, see HandsTracker.step."""
        return self.hands.step(depth_m, k, index, timestamp_s, began_s)[0]

    def restart(self, side: str | None = None) -> None:
        """Forget the hand, see HandsTracker.restart."""
        self.hands.restart(side)

    @property
    def state(self) -> TrackerState:
        """All that is carried between frames; one that was kept may be put back."""
        return self.hands.state

    @state.setter
    def state(self, state: TrackerState) -> None:
        self.hands.state = state

    @property
    def model(self) -> FilterModel:
        """The parts of the tracker."""
        return self.hands.model

    @property
    def time(self) -> Timekeeper:
        """What frames take, and what may be spent on them."""
        return self.hands.time

    @property
    def info(self) -> StepInfo | None:
        """What the last step saw and believed; None where it saw no hand."""
        return self.hands.infos[0]

    @property
    def track(self) -> Track | None:
        """The hand that is followed; None while there is none."""
        return self.state.track_of(self.state.slots[0])

    @property
    def shape(self) -> HandShape:
        """The hand that the next frame is compared with."""
        return self.hands.shapes[0]


def _own(estimate: Estimate) -> dict[str, np.ndarray]:
    """Its arrays, for the caller to change: the state keeps the last estimate for lost frames."""
    return {name: a.copy() for name, a in vars(estimate).items() if isinstance(a, np.ndarray)}


def _step(state: TrackerState, image: DepthImage, model: FilterModel) -> StepResult:
    if isinstance(model, PaperModel):
        return paper_step(state, image, model)
    return step(state, image, cast(TrackerModel, model))


def _rendered_hand() -> DepthImage:
    """A small image of an open hand before a wall."""
    pose, (height, width) = np.zeros(27, np.float32), _RENDERED_PX
    pose[1:3] = 0.08, 0.5
    k = np.array([[110.0, 0, width / 2], [0, 110.0, height / 2], [0, 0, 1]])
    depth = model_range_image(pose, default_hand_shape(), k, height, width)
    return DepthImage(np.where(depth > 0, depth, np.float32(1.5)), k, 0, 0.0)
