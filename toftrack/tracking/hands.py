"""One or two hands: a state each, slots that keep to their hand, and who explains which pixels."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import torch

from toftrack.checks import check_number
from toftrack.estimate import Estimate, no_estimate
from toftrack.frames import DepthImage, checked_image
from toftrack.hand.shape import HandShape
from toftrack.pose_space.base import PoseSpace
from toftrack.render.scoring import Scorer
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.state import StepInfo, TrackerState
from toftrack.tracking.step import first_state, step
from toftrack.tracking.tracker import fitted_hand, restarted


class HandsTracker:
    """Follows `hands` hands, each in a slot of its own: slot 0 is the first one that was found.

    states: of the slots.  infos: what the last step saw and believed of each; None before it.
    """

    def __init__(self, model: TrackerModel, seed: int = 0, hands: int = 1) -> None:
        """Raises ToftrackError when `hands` is neither 1 nor 2."""
        check_number("hands", hands, 1, 2, whole=True)
        self.model = model
        self.states: tuple[TrackerState, ...] = tuple(
            first_state(model, seed + slot) for slot in range(hands)
        )
        self.infos: tuple[StepInfo | None, ...] = (None,) * hands

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
        made = [step(state, image, self.model) for state in self.states]
        self.states = tuple(state for state, _, _ in made)
        self.infos = tuple(info for _, info, _ in made)
        took = time.perf_counter() - began
        estimates = tuple(replace(estimate, compute_s=took) for _, _, estimate in made)
        if len(made) == 1:
            return estimates
        return tuple(
            estimate if state.track is not None else _vacant(estimate)
            for state, estimate in zip(self.states, estimates, strict=True)
        )

    def restart(self, side: str | None = None) -> None:
        """Forget the hands, see Tracker.restart; a side is the first one's."""
        first, *others = self.states
        self.states = (
            restarted(first, self.model, side),
            *(restarted(state, self.model) for state in others),
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


def _vacant(estimate: Estimate) -> Estimate:
    """Of a slot without a hand."""
    index, timestamp_s = estimate.index, estimate.timestamp_s
    none = no_estimate(index, timestamp_s, estimate.state_name, len(estimate.latent), math.nan)
    return replace(none, compute_s=estimate.compute_s)
