"""The tracker's state from frame to frame, and what a step says of one frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.pace import Duration, elapsed_s
from toftrack.detector.detection import Detection
from toftrack.detector.parts import ALL_HAND, Parts
from toftrack.detector.proposals import Places
from toftrack.frames.estimate import Estimate
from toftrack.frames.frame import DepthImage
from toftrack.gestures.recognition import GestureState
from toftrack.refinement.shape_fit import ShapeEstimate, first_shape
from toftrack.render.segmentation import Observation
from toftrack.tracking.confidence import JOINT_FEATURES, NO_FEATURES, ConfidenceFeatures

OTHER_SIDE = {"right": "left", "left": "right"}


Record = TypeVar("Record")


def changed(record: Record, **values: Any) -> Record:
    """dataclasses.replace, in a fifth of its time, where no check need run again; cached properties
    keep their values.
    """
    made = object.__new__(type(record))
    vars(made).update(vars(record) | values)
    return made


@dataclass(frozen=True)
class SideEvidence:
    """Evidence for a hand's side, from comparisons; see sides.py.

    fits: log odds of a right hand, summed up over the comparisons.
    body: the same of where a body is beside the arm, their mean.
    comparisons: how many there were.  age_s: how long ago the last one was.
    """

    fits: float = 0.0
    body: float = 0.0
    comparisons: int = 0
    age_s: float = math.inf


@dataclass(frozen=True, eq=False)
class ParticleSet:
    """The particles of a track.

    particles: (N, 6 + d).  weights: (N,) normalised. Both are on the model's device, and all else
        of a track on the CPU.
    mean: (1, 6 + d) of them.
    """

    particles: Tensor
    weights: Tensor
    mean: Tensor


NO_TREND = torch.full((27,), math.nan)
"""The trend of a track that has no second frame yet."""


@dataclass(frozen=True, eq=False)
class Track:
    """A hand that is followed.

    cloud: after the last observation.  velocity: (6 + d,) its mean's smoothed change a second.
    pose: (1, 27) the last estimate; at the start, what the track begins with.
    trend: (27,) its mean change a second, see refinement/steadying.py.
    number: unique.  side: right or left, with the `evidence`.
    age: since it began or restarted.
    likely, doubtful: how long it reached ConfidenceModel.believe, and was below its give_up.
    log_odds: that every joint of the estimate is within 40 mm, smoothed over time.
    whole_odds: that its mean error is, likewise.
    confirmed: one of its estimates was believed, since it was found elsewhere if it was doubted
        then; until then the track is tentative.
    believed_s: since the last believed estimate, or since it began; 0 = the last one is not lost.
    asked_s: since the pose network looked at it.  parts: which pixels it called what then.
    features: of the last estimate, see confidence.py.
    nearest_m: while something hides part of the hand, the depth that its nearest joint was expected
        at; 0 while nothing does.
    """

    cloud: ParticleSet
    velocity: Tensor
    pose: Tensor
    trend: Tensor = NO_TREND
    number: int = 0
    side: str = "right"
    evidence: SideEvidence = SideEvidence()
    shape: ShapeEstimate = field(default_factory=first_shape)
    age: Duration = Duration()
    likely: Duration = Duration()
    doubtful: Duration = Duration()
    log_odds: float = 0.0
    whole_odds: float = 0.0
    confirmed: bool = False
    believed_s: float = 0.0
    asked_s: float = 0.0
    parts: Parts = ALL_HAND
    features: ConfidenceFeatures = NO_FEATURES
    nearest_m: float = 0.0

    @property
    def reliable(self) -> bool:
        """Whether the last estimate was believed."""
        return self.confirmed and self.believed_s == 0


@dataclass(frozen=True, eq=False)
class Slot:
    """A place of the report, for one hand.

    track: number of the track that is reported here; -1 = none.
    side, shape: of the last track here.  known: the side of the last one that was confirmed, which
        what is taken for a hand meanwhile does not change; None = none ever was, or a hand that was
        found before it, and may be the one held out, still is tentative.
    last: the last believed estimate, else the last one; lost and NaN before any.
    gesture: the gestures' state, None where there is none.
    away_s: how long ago a hand was believed here; inf = never.
    joint_features: (21, J) of the last estimate, see confidence.py.
    """

    side: str
    shape: ShapeEstimate
    last: Estimate
    track: int = -1
    known: str | None = None
    gesture: GestureState | None = None
    away_s: float = math.inf
    joint_features: np.ndarray = field(default_factory=lambda: np.zeros((21, len(JOINT_FEATURES))))


NO_PLACES = Places(np.zeros((0, 3)), np.zeros(0))
"""The places of a frame in which the finder was not asked."""


@dataclass(frozen=True, eq=False)
class TrackerState:
    """All that is carried between frames: from the same state and images, the same estimates.

    generator: the state of the random generator, as torch.Generator.get_state() gives it.
    tracks: in the order in which they began.  slots: as many as hands are asked for.
    told: the side of the first slot that the user said; None = nobody did.
    places: what the finder saw in the last frame and nobody waited for; looked at in the next,
        unless the finder is waited for there.  searched_s: since it was last asked.
    next_track, next_index: numbers of the next track, and of the next frame without one.
    timestamp_s: of the last frame, None before any.
    """

    generator: Tensor
    slots: tuple[Slot, ...]
    told: str | None = None
    tracks: tuple[Track, ...] = ()
    places: Places = NO_PLACES
    searched_s: float = math.inf
    next_track: int = 0
    next_index: int = 0
    timestamp_s: float | None = None

    def track_of(self, slot: Slot) -> Track | None:
        """The track of a slot; None where it has none."""
        return next((track for track in self.tracks if track.number == slot.track), None)

    def shows(self, track: Track) -> bool:
        """Whether a track is in a slot."""
        return any(slot.track == track.number for slot in self.slots)

    def elapsed_s(self, image: DepthImage) -> float:
        """Seconds from the last frame to an image, bounded: see compute.pace.elapsed_s."""
        return elapsed_s(self.timestamp_s, image.timestamp_s)

    def at(self, image: DepthImage) -> TrackerState:
        """The state with its clocks at the time of an image; its tracks as they were."""
        before = image.timestamp_s if self.timestamp_s is None else self.timestamp_s
        passed = max(0.0, image.timestamp_s - before)
        return changed(
            self,
            slots=tuple(changed(slot, away_s=slot.away_s + passed) for slot in self.slots),
            searched_s=self.searched_s + passed,
            next_index=image.index + 1,
            timestamp_s=image.timestamp_s,
        )

    def random_generator(self) -> torch.Generator:
        """A CPU generator that goes on from the state."""
        made = torch.Generator()
        made.set_state(self.generator)
        return made


@dataclass(frozen=True, eq=False)
class StepInfo:
    """What a step saw and believed of one hand, for views and tools.

    particles: (N, 6 + d), before refinement; (0, 6 + d) where nothing can be a hand.
    weights: (N,) normalised. Both are on the model's device.
    seconds: wall seconds of each stage.
    features, joint_features: what the confidence was computed from; None where there is no network.
    detection: None where the pose network did not look.
    """

    observation: Observation
    particles: Tensor
    weights: Tensor
    seconds: Mapping[str, float]
    features: ConfidenceFeatures | None = None
    joint_features: np.ndarray | None = None
    detection: Detection | None = None


def generator_on(device: torch.device, generator: torch.Generator) -> torch.Generator:
    """A generator on a device: on the CPU the given one itself, elsewhere a new one that it seeds.

    So only the CPU's generator is carried between frames.
    """
    if device.type == "cpu":
        return generator
    seed = int(torch.randint(2**62, (1,), generator=generator))
    return torch.Generator(device).manual_seed(seed)
