"""What the tracker carries from frame to frame, and what others may see of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.pace import Duration, elapsed_s
from toftrack.detector.hand_detector import Detection
from toftrack.detector.proposals import Places
from toftrack.estimate import Estimate
from toftrack.frames import DepthImage
from toftrack.gestures.recognition import GestureState
from toftrack.refinement.shape_fit import ShapeEstimate, first_shape
from toftrack.render.segmentation import Observation
from toftrack.tracking.confidence import JOINT_FEATURES, NO_FEATURES, ConfidenceFeatures

OTHER_SIDE = {"right": "left", "left": "right"}


@dataclass(frozen=True)
class SideEvidence:
    """What comparisons of a hand's two sides have said, log odds of a right hand; see sides.py.

    fits: by how much better a right hand explains the image than a left one, summed up.
    body_m: how far the body is to the image's right of the hand, on average.
    comparisons: how many there were.  age_s: how long ago the last one was.
    """

    fits: float = 0.0
    body_m: float = 0.0
    comparisons: int = 0
    age_s: float = math.inf


@dataclass(frozen=True, eq=False)
class Track:
    """A hand that is followed.

    particles: (N, 6 + d), after the last observation.  weights: (N,) normalised. Both are on the
        model's device; all else is on the CPU.
    mean: (1, 6 + d), the last estimate in the pose space.  velocity: (6 + d,) its change a second.
    pose: (1, 27) the last estimate; at the start, what the track begins with.
    trend: (27,) its mean change a second, see refinement/steadying.py; NaN at the start.
    number: tells it from all others.  side: right or left, and `evidence` for it.
    shape: the estimate of the hand's shape.
    age: how long it has been followed.
    doubtful: how long its confidence has been below what a track is kept for.
    log_odds: that the estimate is right, smoothed over time.  whole_odds: that its mean error is
        below 40 mm, likewise.
    confirmed: one of its estimates was believed; until then the track is tentative.
    believed_s: how long ago one was, or since it began; 0 = the last one is not lost.
    asked_s: how long ago the pose network was asked about it.
    features: of the last estimate, see confidence.py.
    nearest_m: while something hides part of the hand, the depth that its nearest joint was expected
        at; 0 while nothing does.
    """

    particles: Tensor
    weights: Tensor
    mean: Tensor
    velocity: Tensor
    pose: Tensor
    trend: Tensor = field(default_factory=lambda: torch.full((27,), math.nan))
    number: int = 0
    side: str = "right"
    evidence: SideEvidence = SideEvidence()
    shape: ShapeEstimate = field(default_factory=first_shape)
    age: Duration = Duration()
    doubtful: Duration = Duration()
    log_odds: float = 0.0
    whole_odds: float = 0.0
    confirmed: bool = False
    believed_s: float = 0.0
    asked_s: float = 0.0
    features: ConfidenceFeatures = NO_FEATURES
    nearest_m: float = 0.0

    @property
    def reliable(self) -> bool:
        """Whether the last estimate was believed."""
        return self.confirmed and self.believed_s == 0


@dataclass(frozen=True, eq=False)
class Slot:
    """A place of the report: the hand that a user knows by its number.

    track: number of the track that is reported here; -1 = none.
    side, shape: of the hand that was here last.  known: how surely that is its side, log odds.
    last: the last estimate that was believed, or that there was; lost and NaN before any.
    gesture: smoothed probabilities of the gestures, None where there are none.
    away_s: how long ago a hand was believed here; inf = never.
    joint_features: (21, J) of the last estimate, see confidence.py.
    """

    side: str
    shape: ShapeEstimate
    last: Estimate
    track: int = -1
    known: float = 0.0
    gesture: GestureState | None = None
    away_s: float = math.inf
    joint_features: np.ndarray = field(default_factory=lambda: np.zeros((21, len(JOINT_FEATURES))))


NO_PLACES = Places(np.zeros((0, 3)), np.zeros(0))
"""Of a frame in which the finder was not asked."""


@dataclass(frozen=True, eq=False)
class TrackerState:
    """All that is carried between frames: from the same state and images, the same estimates.

    generator: the state of the random generator, as torch.Generator.get_state() gives it.
    tracks: the hands that are followed, each a row; the surest of them are reported.
    slots: as many as hands are asked for.
    told: the side that the user said of the first one; None = nobody did.
    places: where the finder has seen hands in the last frame; `found_s` ago.
    refused: (R, 4) middles of what was taken for a hand and was none, and how long ago that was.
    next_track, next_index: numbers of the next track, and of the next frame without one.
    timestamp_s: of the last frame, None before any.
    """

    generator: Tensor
    slots: tuple[Slot, ...]
    told: str | None = None
    tracks: tuple[Track, ...] = ()
    places: Places = NO_PLACES
    found_s: float = math.inf
    refused: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    next_track: int = 0
    next_index: int = 0
    timestamp_s: float | None = None

    def track_of(self, slot: Slot) -> Track | None:
        """The hand that is reported in a slot."""
        return next((track for track in self.tracks if track.number == slot.track), None)

    def elapsed_s(self, image: DepthImage) -> float:
        """Seconds from the last frame to an image, as motions are reckoned with."""
        return elapsed_s(self.timestamp_s, image.timestamp_s)

    def at(self, image: DepthImage) -> TrackerState:
        """The state as time goes on to an image."""
        before = image.timestamp_s if self.timestamp_s is None else self.timestamp_s
        passed = max(0.0, image.timestamp_s - before)
        refused = self.refused + np.array([0.0, 0.0, 0.0, passed])
        return replace(
            self,
            slots=tuple(replace(slot, away_s=slot.away_s + passed) for slot in self.slots),
            found_s=self.found_s + passed,
            refused=refused[refused[:, 3] < REFUSED_S],
            next_index=image.index + 1,
            timestamp_s=image.timestamp_s,
        )

    def random_generator(self) -> torch.Generator:
        """The random generator, on the CPU."""
        made = torch.Generator()
        made.set_state(self.generator)
        return made


REFUSED_S = 1.5
"""What was taken for a hand and was none is left alone for so long, if it stays where it is."""


@dataclass(frozen=True, eq=False)
class StepInfo:
    """What a step saw and believed of one hand; for those who watch it.

    particles: (N, 6 + d) before the estimate was refined; none where nothing can be a hand.
    weights: (N,) normalised. Both are on the model's device.
    seconds: wall seconds of each stage.
    features, joint_features: what the confidence was computed from; None where there is no network.
    detection: what the network said; None in a frame in which it was not asked.
    """

    observation: Observation
    particles: Tensor
    weights: Tensor
    seconds: Mapping[str, float]
    features: ConfidenceFeatures | None = None
    joint_features: np.ndarray | None = None
    detection: Detection | None = None


def generator_on(device: torch.device, generator: torch.Generator) -> torch.Generator:
    """The generator to draw particles with on a device; on the CPU it is the given one itself.

    Elsewhere the given one seeds it, so that nothing but the CPU's is carried between frames.
    """
    if device.type == "cpu":
        return generator
    seed = int(torch.randint(2**62, (1,), generator=generator))
    return torch.Generator(device).manual_seed(seed)
