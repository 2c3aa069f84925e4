"""The tracker: a frame in, an estimate out, a state held in between (paper, fig. 1)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from toftrack.compute.threads import at_most
from toftrack.estimate import Estimate
from toftrack.frames import DepthImage, checked_image
from toftrack.hand.shape import HandShape
from toftrack.pose_space.base import PoseSpace
from toftrack.render.scoring import Scorer
from toftrack.tracking.model import FilterModel, TrackerModel
from toftrack.tracking.paper import PaperModel, paper_step
from toftrack.tracking.quality import Pace, Timekeeper
from toftrack.tracking.state import StepInfo, Track, TrackerState
from toftrack.tracking.step import step


def stepped(
    state: TrackerState, image: DepthImage, model: FilterModel
) -> tuple[TrackerState, StepInfo, Estimate]:
    """One frame of one hand, by the tracker that a model is of: see step and paper_step."""
    if isinstance(model, PaperModel):
        return paper_step(state, image, model)
    assert isinstance(model, TrackerModel)
    return step(state, image, model)


class Tracker:
    """Follows one hand through rectified depth images: holds the state of `step`.

    state: all that is carried between frames; one that was kept may be put back.
    info: what the last step saw and believed; None before the first one.
    time: what frames take, and what may be spent on them.
    """

    def __init__(
        self,
        model: FilterModel,
        seed: int = 0,
        pace: Pace | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """pace: of a live device; None spends all effort on each frame.  clock: of `began_s`."""
        self.model, self.time = model, Timekeeper(pace, clock)
        self.state: TrackerState = model.first_state(seed)
        self.info: StepInfo | None = None

    def step(
        self,
        depth_m: np.ndarray,
        k: np.ndarray,
        index: int | None = None,
        timestamp_s: float | None = None,
        began_s: float | None = None,
    ) -> Estimate:
        """One frame.

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
        timestamp_s = time.monotonic() if timestamp_s is None else timestamp_s
        image = DepthImage(depth_m, k, index, timestamp_s)
        with at_most(quality.threads):
            model = self.model.at_quality(quality)
            self.state, self.info, estimate = stepped(self.state, image, model)
        return replace(estimate, compute_s=self.time.took_s())

    def restart(self, side: str | None = None) -> None:
        """Forget the hand, also its size, and look for one anew; of another side if one is given.

        Only random numbers and frame numbers go on. Raises ToftrackError for an unknown side.
        """
        self.state = restarted(self.state, self.model, side)
        self.info = None

    @property
    def shape(self) -> HandShape:
        """The hand that the next frame is compared with."""
        return self.model.hand(self.state.side, self.state.size).shape

    @property
    def fitted(self) -> HandShape:
        """The same hand, with how sure the fit is of it."""
        return self.model.fitted(self.state.side, self.state.size)

    @property
    def scorer(self) -> Scorer:
        """The back end's, for that hand."""
        return self.model.hand(self.state.side, self.state.size).scorer

    @property
    def space(self) -> PoseSpace:
        """The pose space."""
        return self.model.space

    @property
    def device(self) -> torch.device:
        """Where everything is computed."""
        return self.model.device

    @property
    def track(self) -> Track | None:
        """The hand that is followed; None while there is none."""
        return self.state.track

    @property
    def insight(self) -> StepInfo | None:
        """What the last step saw and believed; None where nothing could be a hand."""
        return None if self.info is None or self.info.observation.empty else self.info


def restarted(state: TrackerState, model: FilterModel, side: str | None = None) -> TrackerState:
    """A state that has seen nothing, but for its random and frame numbers; of a side if one is
    given, which is told from then on.

    Raises ToftrackError for an unknown side.
    """
    first = model.first_state(0)
    if side is not None:
        first = replace(first, side=model.shape.of_side(side).side, sides=None)
    elif state.sides is None:
        first = replace(first, side=state.side, sides=None)
    return replace(first, generator=state.generator, next_index=state.next_index)
