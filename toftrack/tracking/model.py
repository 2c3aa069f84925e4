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
from toftrack.errors import ToftrackError
from toftrack.gestures.recognition import Gestures
from toftrack.hand.shape import HandShape
from toftrack.hand.shape_space import shape_derivatives, shaped
from toftrack.pose_space.base import PoseSpace, clamp_to_joint_limits
from toftrack.pose_space.data.natural_poses import natural_poses
from toftrack.pose_space.density import LatentDensity, latent_density
from toftrack.refinement.gauss_newton import Refinement, Refiner
from toftrack.relocation.relocaliser import Glance, Relocaliser
from toftrack.render.likelihood import FMeasure
from toftrack.render.scoring import Counts, Evidence, Scorer
from toftrack.render.segmentation import NearestSurface, Observation
from toftrack.tracking.belief import CalibratedBelief
from toftrack.tracking.effort import Effort
from toftrack.tracking.life_cycle import LostSettings
from toftrack.tracking.other_hand import OtherHand
from toftrack.tracking.particle_filter import FilterSettings, Spread, bound
from toftrack.tracking.search import LastSeen, Start
from toftrack.tracking.shape_fit import ShapeBelief, ShapeFit
from toftrack.tracking.side_belief import SideFit
from toftrack.tracking.size_fit import HandFit, SizeBelief

_MODEL_ERROR = Spread(0.002, 0.002, 0.015, 0.015)
"""What the particles do not know: the hand model's own error. Added to their covariance, it makes
the 90 % region of a joint hold the truth in about 93 % of the frames of rendered recordings."""
_HIDDEN = 0.03
"""Share of the hand's pixels that must be hidden for it to matter."""
_HANDS = 32
"""Hands that are kept made; a fit of the size tries no more."""


@dataclass(frozen=True, eq=False)
class SizedHand:
    """A hand of one side and shape, and what was made for it.

    first: the hand whose components `worn` is away from; see hand/shape_space.py.
    """

    shape: HandShape
    scorer: Scorer
    refiner: Refiner
    first: HandShape
    worn: tuple[float, ...] = ()

    @cached_property
    def derivatives(self) -> tuple[Tensor, Tensor]:
        """How roots and bones change with the components, on the CPU, see shape_derivatives."""
        return shape_derivatives(self.first.to("cpu"), torch.tensor(self.worn))


@dataclass(frozen=True, eq=False)
class TrackerModel:
    """The parts of a tracker, on the CPU but for those that the back end makes.

    shape: the hand as configured, before any of its size was fitted.
    refinement: None leaves the filter's estimate as it is.
    fit: of the size alone, where there are no networks; None leaves the hand as it is.
    adapt: of the shape, by what the networks say; None likewise.
    sides: how the side is found out, by the networks; None where it was told.
    gestures: None tells none.
    relocaliser: None searches for starts, and challenges no track.
    """

    shape: HandShape
    space: PoseSpace
    segmentation: NearestSurface
    likelihood: FMeasure
    filter: FilterSettings
    refinement: Refinement | None
    start: Start
    lost: LostSettings | CalibratedBelief
    fit: HandFit | None
    gestures: Gestures | None
    backend: Backend
    relocaliser: Relocaliser | None = None
    adapt: ShapeFit | None = None
    sides: SideFit | None = None

    def __post_init__(self) -> None:
        if isinstance(self.lost, CalibratedBelief) and self.relocaliser is None:
            raise ToftrackError(
                "lost=calibrated judges by what the networks say, but relocation=none has none;"
                " give lost=score as well, or relocation=network"
            )

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

    def spending(self, effort: Effort) -> TrackerModel:
        """The same tracker with less effort; itself where nothing is left out."""
        return self._spending(effort)

    @cached_property
    def _spending(self) -> Callable[[Effort], TrackerModel]:
        return lru_cache(partial(_spending, self))

    @property
    def rivals(self) -> int:
        """How many of the networks' poses compete with a track."""
        return 0 if self.relocaliser is None else self.relocaliser.settings.rivals

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

    @cached_property
    def poses(self) -> Tensor:
        """(M, 21) rad, natural poses, to take single fingers from."""
        return natural_poses()

    def hand(self, side: str, belief: SizeBelief | ShapeBelief | None) -> SizedHand:
        """The hand of a side in the size or the shape that is believed in."""
        if isinstance(belief, ShapeBelief):
            return self._hands(side, 1.0, belief.worn)
        ratio = 1.0 if belief is None or self.fit is None else belief.ratio(self.fit)
        return self._hands(side, ratio, ())

    @cached_property
    def _hands(self) -> Callable[[str, float, tuple[float, ...]], SizedHand]:
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


def _spending(model: TrackerModel, effort: Effort) -> TrackerModel:
    if effort == Effort(effort.threads):
        return model

    refinement, relocaliser = model.refinement, model.relocaliser
    if refinement is not None:
        refinement = replace(refinement, swaps=math.ceil(effort.swaps * refinement.swaps))
    if relocaliser is not None:
        told = relocaliser.settings
        told = replace(
            told,
            every=max(told.every, effort.every),
            search=max(told.search, effort.search),
            rivals=_least(told.rivals, effort.rivals),
            places=_least(told.places, effort.places),
        )
        relocaliser = replace(relocaliser, settings=told)
    made = replace(model, refinement=refinement, relocaliser=relocaliser)
    vars(made)["_hands"] = model._hands  # compiled parts that do not depend on the effort
    return made


def _least(count: int, most: int | None) -> int:
    return count if most is None else min(count, most)


def _sized_hand(
    shape: HandShape, backend: Backend, side: str, ratio: float, worn: tuple[float, ...]
) -> SizedHand:
    first = shape.of_side(side)
    sized = shaped(first, torch.tensor(worn)) if worn else first.scaled(ratio)
    return SizedHand(sized, backend.make_scorer(sized), backend.make_refiner(sized), first, worn)


@dataclass(frozen=True, eq=False)
class ObservedFrame:
    """A frame that may show a hand, and the hand looked for: the judge of hypotheses.

    evidence: on the model's device.
    glance: what the networks say of the hand.  seen: the hand as it was last believed.
    other: another hand that is tracked as well.
    """

    observation: Observation
    evidence: Evidence
    hand: SizedHand
    model: TrackerModel
    glance: Glance | None = None
    seen: LastSeen | None = None
    other: OtherHand | None = None

    @property
    def hidden(self) -> bool:
        """Whether something hides part of the hand."""
        occluder = self.observation.occluder
        if self.model.relocaliser is None:
            return bool(occluder.any())
        return int(occluder.sum()) > _HIDDEN * int(self.observation.hand.sum())

    def counts(self, states: Tensor, evidence: Evidence | None = None) -> Counts:
        """(N, 27) hands, on the CPU or the model's device, counted there and told where they are.

        evidence: instead of the frame's own, on the model's device.
        """
        evidence = evidence or self.evidence
        if states.device.type != "cpu":
            return self.hand.scorer(states, evidence)
        there = on_device(states, self.model.device)
        return Counts(*on_host(*self.hand.scorer(there, evidence)))

    def log_scores(self, states: Tensor, coverage: float | None = None) -> Tensor:
        """(N, 27) hands to (N,) what they are weighed by, see FMeasure.log_score."""
        return self.model.likelihood.log_score(self.counts(states), coverage)

    def score(self, state: Tensor) -> float:
        """(1, 27) to the likelihood head's score, 0..1."""
        return float(self.model.likelihood.score(self.counts(state)))


def observed(
    observation: Observation,
    hand: SizedHand,
    model: TrackerModel,
    glance: Glance | None = None,
    seen: LastSeen | None = None,
    other: OtherHand | None = None,
) -> ObservedFrame:
    """A segmented frame, which is not empty; its evidence is on the model's device."""
    evidence = model.likelihood.evidence(observation).to(model.device)
    return ObservedFrame(observation, evidence, hand, model, glance, seen, other)
