"""The parts of a tracker and their settings, which do not change from frame to frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.particle_filter import FilterSettings, Spread
from toftrack.compute.quality import Quality
from toftrack.compute.rigid import bound
from toftrack.detector.hand_detector import HandDetector
from toftrack.frames.estimate import no_estimate
from toftrack.gestures.recognition import Gestures
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, HandShape, default_hand_shape
from toftrack.hand.shape_space import shape_derivatives, shaped
from toftrack.pose_space.base import PoseSpace
from toftrack.refinement.gauss_newton import Refinement
from toftrack.refinement.gauss_newton_numba import Refiner
from toftrack.refinement.shape_fit import ShapeEstimate, first_shape
from toftrack.render.likelihood import Likelihood
from toftrack.render.scoring import Evidence, Scorer
from toftrack.render.segmentation import NearestSurface, Observation
from toftrack.tracking.backend import Backend
from toftrack.tracking.confidence import ConfidenceModel
from toftrack.tracking.posterior import PosteriorWeights
from toftrack.tracking.state import OTHER_SIDE, Slot, TrackerState, changed

_MODEL_ERROR = Spread(0.002, 0.002, 0.015, 0.015)
"""What the particles do not know: the hand model's own error. Added to their covariance, it makes
the 90 % region of a joint hold the truth in about 93 % of the frames of rendered recordings."""


@dataclass(frozen=True)
class Hand:
    """The configured hand: a shape, whether it is fitted to the user, and whether the user said its
    side; otherwise it is detected.
    """

    shape: HandShape
    fitted: bool
    side_given: bool


def make_hand(shape: str, side: str, length_m: float) -> Hand:
    """The configured hand: the mean adult's scaled to a length, or one read from a file.

    shape: "default"; "auto", the same as a guess that is fitted; or the path of a hand-shape file.
    side: "auto" is detected, and begins as a right hand.
    Raises ToftrackError for an unknown side, an impossible length or an unreadable file.
    """
    known = "right" if side == "auto" else side
    if shape in ("default", "auto"):
        made = default_hand_shape(length_m, known)
    else:
        made = HandShape.load(shape).of_side(known)
    return Hand(made, shape == "auto", side != "auto")


@dataclass(frozen=True, eq=False)
class FittedHand:
    """A hand of one side and shape, and what computes with it.

    first, applied: `shape` is `first` changed by the components `applied`; see hand/shape_space.py.
    """

    shape: HandShape
    scorer: Scorer
    refiner: Refiner
    first: HandShape
    applied: tuple[float, ...]

    @cached_property
    def ratio(self) -> float:
        """Its length in lengths of the mean adult's."""
        return self.shape.hand_length_m / DEFAULT_HAND_LENGTH_M

    @cached_property
    def derivatives(self) -> tuple[np.ndarray, np.ndarray]:
        """How roots and bones change with the components, see shape_derivatives."""
        return shape_derivatives(self.first, torch.tensor(self.applied))


@dataclass(frozen=True, eq=False)
class FilterModel:
    """The parts of every tracker; on the CPU but for the particles and the back end's scorers.

    detects: whether networks detect hands: they tell several apart, and a hand's side.
    gestures: None recognises none.
    """

    detects: ClassVar[bool] = False

    configured: Hand
    space: PoseSpace
    segmentation: NearestSurface
    likelihood: Likelihood
    filter: FilterSettings
    gestures: Gestures | None
    backend: Backend

    def first_state(self, seed: int, hands: int = 1, side: str | None = None) -> TrackerState:
        """The state before any frame, with `hands` slots, which alternate between the sides.

        side: of the first, right or left; None = as configured, "auto" = detected.
        """
        told = self.configured.shape.side if self.configured.side_given else None
        told = told if side is None else side if side in OTHER_SIDE else None
        first = told or self.configured.shape.side
        nothing = no_estimate(-1, math.nan, "lost", self.space.dims, math.nan)
        slots = tuple(
            Slot(OTHER_SIDE[first] if number % 2 else first, first_shape(), nothing)
            for number in range(hands)
        )
        generator = torch.Generator().manual_seed(seed)
        return TrackerState(generator.get_state(), slots, told)

    def at_quality(self, quality: Quality) -> FilterModel:
        """The same tracker with less effort; itself where nothing is left out."""
        return self

    @property
    def fits(self) -> bool:
        """Whether the hand's shape is fitted to the user."""
        return self.detects and self.configured.fitted

    def fitted(self, slot: Slot) -> HandShape:
        """A slot's hand; where its shape was fitted to some pose, with the uncertainty."""
        shape = self.hand(slot.side, slot.shape).shape
        if not (self.fits and slot.shape.poses):
            return shape
        return replace(shape, fitted=slot.shape.summary())

    @property
    def device(self) -> torch.device:
        """The particles' device."""
        return self.backend.device

    def space_of(self, particles: Tensor) -> PoseSpace:
        """The pose space on the particles' device."""
        return self.space if particles.device.type == "cpu" else self._space_there

    @cached_property
    def _space_there(self) -> PoseSpace:
        return self.space.to(self.device)

    @cached_property
    def sigmas(self) -> Tensor:
        """(6 + d,) standard deviations of the filter's first diffusion at a moderate speed."""
        return self.filter.spread.sigmas(self.space.lower, self.space.upper)

    @cached_property
    def model_variance(self) -> Tensor:
        """(6 + d,) variances to be added to the particles' covariance, see _MODEL_ERROR."""
        return _MODEL_ERROR.sigmas(self.space.lower, self.space.upper).square()

    def hand(self, side: str, shape: ShapeEstimate) -> FittedHand:
        """The hand of a side in the applied shape; the last 32 ones are cached."""
        return self._hands(side, shape.applied)

    @cached_property
    def _hands(self) -> Callable[[str, tuple[float, ...]], FittedHand]:
        return lru_cache(32)(partial(_fitted_hand, self.configured.shape, self.backend))

    @cached_property
    def evidence(self) -> Callable[[Observation], Evidence]:
        """Of an observation, on the particles' device; that of the last few is cached."""
        return lru_cache(4)(lambda seen: self.likelihood.evidence(seen).to(self.device))

    def decode(self, particles: Tensor) -> Tensor:
        """(N, 27) poses of particles (N, 6 + d), within the joints' limits."""
        angles = self.space_of(particles).decode(particles[:, 6:])
        return torch.cat((particles[:, :6], angles), 1)

    def encode(self, states: Tensor) -> Tensor:
        """(N, 6 + d) the particles nearest to poses (N, 27) on the CPU, within the bounds."""
        latent = self.space.encode(states[:, 6:])
        latent = bound(latent, self.space.lower, self.space.upper, "truncate")
        return torch.cat((states[:, :6], latent), 1)


@dataclass(frozen=True, eq=False)
class TrackerModel(FilterModel):
    """The parts of the tracker with networks.

    posterior: the weights of its terms.
    lost: when an estimate is lost, and when its track ends.
    """

    detects: ClassVar[bool] = True

    detector: HandDetector
    refinement: Refinement
    posterior: PosteriorWeights
    lost: ConfidenceModel

    def at_quality(self, quality: Quality) -> TrackerModel:
        """See FilterModel. What is cached is shared, as only the detector's settings differ."""
        if quality == Quality(quality.threads):
            return self
        settings, most = self.detector.settings, quality.places
        settings = changed(
            settings,
            every=max(settings.every, quality.every),
            search=max(settings.search, quality.search),
            places=settings.places if most is None else min(settings.places, most),
        )
        detector = changed(self.detector, settings=settings)
        return changed(self, detector=detector, _hands=self._hands)


def _fitted_hand(
    shape: HandShape, backend: Backend, side: str, applied: tuple[float, ...]
) -> FittedHand:
    first = shape.of_side(side)
    made = shaped(first, torch.tensor(applied))
    return FittedHand(made, backend.make_scorer(made), Refiner(made), first, applied)
