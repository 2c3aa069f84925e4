"""What does not change from frame to frame: the parts of a tracker and their settings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import torch
from torch import Tensor

from toftrack.compute.backend import Backend
from toftrack.compute.transfer import on_device, on_host
from toftrack.detector.hand_detector import Detection, HandDetector
from toftrack.gestures.recognition import Gestures
from toftrack.hand import make_hand_shape
from toftrack.hand.shape import HandShape
from toftrack.hand.shape_space import shape_derivatives, shaped
from toftrack.pose_space.base import PoseSpace, clamp_to_joint_limits
from toftrack.pose_space.data.natural_poses import natural_poses
from toftrack.pose_space.density import LatentDensity, latent_density
from toftrack.refinement.gauss_newton import Refinement, Refiner
from toftrack.render.likelihood import FMeasure
from toftrack.render.scoring import Counts, Evidence, Scorer
from toftrack.render.segmentation import NearestSurface, Observation
from toftrack.tracking.confidence import ConfidenceModel
from toftrack.tracking.handedness_estimate import HandednessEstimate, HandednessSettings
from toftrack.tracking.other_hand import OtherHand
from toftrack.tracking.particle_filter import FilterSettings, Spread, bound
from toftrack.tracking.prior import LastSeen, Prior
from toftrack.tracking.quality import Quality
from toftrack.tracking.shape_fit import ShapeEstimate, ShapeFit, first_shape
from toftrack.tracking.state import TrackerState

_MODEL_ERROR = Spread(0.002, 0.002, 0.015, 0.015)
"""What the particles do not know: the hand model's own error. Added to their covariance, it makes
the 90 % region of a joint hold the truth in about 93 % of the frames of rendered recordings."""
_HIDDEN = 0.03
"""Share of the hand's pixels that must be hidden for it to matter."""
_HANDS = 32
"""Hands that are kept made."""


@dataclass(frozen=True)
class Hand:
    """The hand of a configuration: a shape, and how it is fitted to the user.

    sides: how its side is found out; None where it is told.
    """

    shape: HandShape
    adapt: ShapeFit
    sides: HandednessSettings | None


def make_hand(
    shape: str, side: str, length_m: float, adapt: ShapeFit, sides: HandednessSettings
) -> Hand:
    """See toftrack.hand.make_hand_shape; only shape="auto" is fitted, and only side="auto" found
    out: it begins as a right hand.
    """
    made = make_hand_shape(shape, "right" if side == "auto" else side, length_m)
    adapt = replace(adapt, fixed=shape != "auto")
    return Hand(made, adapt, sides if side == "auto" else None)


@dataclass(frozen=True, eq=False)
class SizedHand:
    """A hand of one side and shape, and what was made for it.

    first: the hand whose components `worn` is away from; see hand/shape_space.py.
    """

    shape: HandShape
    scorer: Scorer
    refiner: Refiner
    first: HandShape
    applied: tuple[float, ...]

    @cached_property
    def derivatives(self) -> tuple[Tensor, Tensor]:
        """How roots and bones change with the components, on the CPU, see shape_derivatives."""
        return shape_derivatives(self.first.to("cpu"), torch.tensor(self.applied))


@dataclass(frozen=True, eq=False)
class FilterModel:
    """What every tracker has: a hand, its pose space, and particles that are compared with images.

    All is on the CPU but for those parts that the back end makes.

    shape: the hand as configured, before it was fitted.
    gestures: None tells none.
    """

    shape: HandShape
    space: PoseSpace
    segmentation: NearestSurface
    likelihood: FMeasure
    filter: FilterSettings
    gestures: Gestures | None
    backend: Backend

    def first_state(self, seed: int) -> TrackerState:
        """Before any frame."""
        generator = torch.Generator().manual_seed(seed)
        return TrackerState(generator.get_state(), self.shape.side, first_shape())

    def at_quality(self, quality: Quality) -> FilterModel:
        """The same tracker with less effort; itself where nothing is left out."""
        return self

    @property
    def fits(self) -> bool:
        """Whether the hand's shape is fitted to the user."""
        return False

    def fitted(self, side: str, belief: ShapeEstimate) -> HandShape:
        """The hand of a side, with how sure the fit is of it if there is one."""
        return self.hand(side, belief).shape

    @property
    def device(self) -> torch.device:
        """Where the particles are."""
        return self.backend.device

    def space_of(self, particles: Tensor) -> PoseSpace:
        """The pose space where particles are."""
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
        """(6 + d,) of what the particles do not know."""
        return _MODEL_ERROR.sigmas(self.space.lower, self.space.upper).square()

    def log_prior(self, particles: Tensor) -> Tensor | None:
        """(N, 6 + d) to (N,) what speaks for a pose before the image does; None where nothing."""
        if self._density is None:
            return None
        return self.filter.density * self._density.log_density(particles[:, 6:])

    @cached_property
    def _density(self) -> LatentDensity | None:
        space = self.space if self.device.type == "cpu" else self._space_there
        return latent_density(space) if self.filter.density else None

    def hand(self, side: str, belief: ShapeEstimate) -> SizedHand:
        """The hand of a side in the shape that is believed in."""
        return self._hands(side, belief.applied)

    @cached_property
    def _hands(self) -> Callable[[str, tuple[float, ...]], SizedHand]:
        return lru_cache(_HANDS)(partial(_sized_hand, self.shape, self.backend))

    def decode(self, particles: Tensor, offset: Tensor | float = 0.0) -> Tensor:
        """(N, 6 + d) particles to (N, 27) hand states, all displaced by `offset` (21,) rad."""
        decoded = self.space_of(particles).decode(particles[:, 6:])
        angles = clamp_to_joint_limits(decoded + offset)
        return torch.cat((particles[:, :6], angles), 1)

    def encode(self, states: Tensor) -> Tensor:
        """(N, 27) hand states to the nearest particles within the space's bounds, (N, 6 + d)."""
        latent = self.space.encode(states[:, 6:])
        latent = bound(latent, self.space.lower, self.space.upper, "truncate")
        return torch.cat((states[:, :6], latent), 1)

    def nearest(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """One hand (1, 27) as a particle (1, 6 + d), and how far off that is, (21,) rad."""
        particle = self.encode(state)
        return particle, state[0, 6:] - self.space.decode(particle[:, 6:])[0]


@dataclass(frozen=True, eq=False)
class TrackerModel(FilterModel):
    """The parts of the tracker with networks.

    prior: what speaks for a hand besides the image and the networks.
    adapt: how the shape is fitted, by what the networks say.
    sides: how the side is found out, by the networks; None where it was told.
    """

    detector: HandDetector
    refinement: Refinement
    prior: Prior
    lost: ConfidenceModel
    adapt: ShapeFit
    sides: HandednessSettings | None = None

    def first_state(self, seed: int) -> TrackerState:
        """See FilterModel."""
        sides = None if self.sides is None else HandednessEstimate()
        return replace(super().first_state(seed), sides=sides)

    def at_quality(self, quality: Quality) -> TrackerModel:
        """See FilterModel."""
        return self._at_quality(quality)

    @cached_property
    def _at_quality(self) -> Callable[[Quality], TrackerModel]:
        return lru_cache(partial(_at_quality, self))

    @property
    def fits(self) -> bool:
        """See FilterModel."""
        return not self.adapt.fixed

    def fitted(self, side: str, belief: ShapeEstimate) -> HandShape:
        """See FilterModel; None is said of the fit before anything was fitted."""
        shape = super().fitted(side, belief)
        if not (self.fits and belief.poses):
            return shape
        return replace(shape, fitted=belief.summary(self.adapt))

    @cached_property
    def poses(self) -> Tensor:
        """(M, 21) rad, natural poses, to take single fingers from."""
        return natural_poses()


def _at_quality(model: TrackerModel, quality: Quality) -> TrackerModel:
    if quality == Quality(quality.threads):
        return model
    reported, refinement = model.detector.settings, model.refinement
    reported = replace(
        reported,
        every=max(reported.every, quality.every),
        search=max(reported.search, quality.search),
        rivals=_least(reported.rivals, quality.rivals),
        places=_least(reported.places, quality.places),
    )
    made = replace(
        model,
        refinement=replace(refinement, swaps=math.ceil(quality.swaps * refinement.swaps)),
        detector=replace(model.detector, settings=reported),
    )
    vars(made)["_hands"] = model._hands  # compiled parts that do not depend on the effort
    return made


def _least(count: int, most: int | None) -> int:
    return count if most is None else min(count, most)


def _sized_hand(
    shape: HandShape, backend: Backend, side: str, applied: tuple[float, ...]
) -> SizedHand:
    first = shape.of_side(side)
    sized = shaped(first, torch.tensor(applied))
    return SizedHand(sized, backend.make_scorer(sized), backend.make_refiner(sized), first, applied)


@dataclass(frozen=True, eq=False)
class ObservedFrame:
    """A frame that may show a hand, and the hand looked for: the judge of hypotheses.

    evidence: on the model's device.
    """

    observation: Observation
    evidence: Evidence
    hand: SizedHand
    model: FilterModel

    def counts(self, states: Tensor) -> Counts:
        """(N, 27) hands, on the CPU or the model's device, counted there and told here."""
        if states.device.type != "cpu":
            return self.hand.scorer(states, self.evidence)
        there = on_device(states, self.model.device)
        return Counts(*on_host(*self.hand.scorer(there, self.evidence)))

    def log_scores(self, states: Tensor, coverage: float | None = None) -> Tensor:
        """(N, 27) hands to (N,) what they are weighed by, see FMeasure.log_score."""
        return self.model.likelihood.log_score(self.counts(states), coverage)

    def score(self, state: Tensor) -> float:
        """(1, 27) to the likelihood head's score, 0..1."""
        return float(self.model.likelihood.score(self.counts(state)))


@dataclass(frozen=True, eq=False)
class DetectedFrame(ObservedFrame):
    """The same, with what else is known of the hand.

    glance: what the networks say of it; None in a frame in which they do not look.
    seen: the hand as it was last believed.
    other: another hand that is tracked as well.
    """

    model: TrackerModel
    detection: Detection | None
    seen: LastSeen | None
    other: OtherHand | None

    @property
    def hidden(self) -> bool:
        """Whether something hides part of the hand."""
        hand, occluder = self.observation.hand, self.observation.occluder
        return int(occluder.sum()) > _HIDDEN * int(hand.sum())


def evidence_of(observation: Observation, model: FilterModel) -> Evidence:
    """Of an observation that is not empty, on the model's device."""
    return model.likelihood.evidence(observation).to(model.device)


def observed(
    observation: Observation,
    hand: SizedHand,
    model: TrackerModel,
    detection: Detection | None = None,
    seen: LastSeen | None = None,
    other: OtherHand | None = None,
) -> DetectedFrame:
    """A segmented frame, which is not empty."""
    evidence = evidence_of(observation, model)
    return DetectedFrame(observation, evidence, hand, model, detection, seen, other)
