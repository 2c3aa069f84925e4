"""What the tracker carries from frame to frame, and what others may see of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.pace import Duration, elapsed_s
from toftrack.compute.rigid import pivot_offset
from toftrack.detector.hand_detector import Detection
from toftrack.estimate import Estimate
from toftrack.frames import DepthImage
from toftrack.gestures.recognition import GestureState
from toftrack.refinement.shape_fit import ShapeEstimate
from toftrack.render.segmentation import Observation
from toftrack.tracking.confidence import JOINT_FEATURES, NO_FEATURES, ConfidenceFeatures
from toftrack.tracking.handedness import HandednessEstimate


@dataclass(frozen=True, eq=False)
class Track:
    """A hand that is followed.

    particles: (N, 6 + d), after the last observation.  weights: (N,) normalised. Both are on the
        model's device; all else is on the CPU.
    mean: (1, 6 + d), the last estimate in the pose space.  velocity: (6 + d,) its change a second.
    pose: (1, 27) the last estimate; at the start, what the track begins with.
    trend: (27,) its mean change a second, see refinement/steadying.py; NaN at the start.
    age: how long it has been followed.
    doubtful: how long its confidence has been below what a track is kept for.
    log_odds: that the estimate is right, smoothed over time.  whole_odds: that its mean error is
        below 40 mm, likewise.
    surest: the highest log odds so far.
    doubted: the last estimate was flagged lost.  believed: one of its estimates was not.
    unseen_s: how long ago the pose network was asked about it.
    features, joint_features: of the last estimate, (21, J); see confidence.py.
    nearest_m: while something hides part of the hand, the depth that its nearest joint was expected
        at; 0 while nothing does.
    """

    particles: Tensor
    weights: Tensor
    mean: Tensor
    velocity: Tensor
    pose: Tensor
    trend: Tensor = field(default_factory=lambda: torch.full((27,), math.nan))
    age: Duration = Duration()
    doubtful: Duration = Duration()
    log_odds: float = 0.0
    whole_odds: float = 0.0
    surest: float = -math.inf
    doubted: bool = False
    believed: bool = False
    unseen_s: float = 0.0
    features: ConfidenceFeatures = NO_FEATURES
    joint_features: np.ndarray = field(default_factory=lambda: np.zeros((21, len(JOINT_FEATURES))))
    nearest_m: float = 0.0


@dataclass(frozen=True, eq=False)
class LastSeen:
    """A hand as it was last believed.

    particle: (1, 6 + d).  age_s: how long ago; inf = it never was.
    surest: the highest log odds of its track that an estimate was right; -inf = none was believed.
    """

    particle: Tensor
    age_s: float
    surest: float = math.inf

    @property
    def ever(self) -> bool:
        """Whether there was one."""
        return self.age_s < math.inf

    @property
    def centre_m(self) -> np.ndarray:
        """(3,) middle of its palm."""
        particle = self.particle.numpy()
        centre: np.ndarray = particle[0, :3] + pivot_offset(particle[:, 3:6])[0]
        return centre

    def after(self, dt_s: float) -> LastSeen:
        """As time goes on."""
        return replace(self, age_s=self.age_s + dt_s)


@dataclass(frozen=True, eq=False)
class Seeking:
    """A search of the whole image for a hand that goes on over frames; see seeking.py.

    centres_m: (P, 3) places that were not looked at yet.  heat: (P,) how likely the finder has a
    hand there.  seen: what the pose network said of the others, and the finder's probability.
    alone: the image is searched without the pixels of the other hand.  anew: ... from the next
        frame on, for with them there was no place but that hand's.
    """

    centres_m: np.ndarray
    heat: np.ndarray
    seen: tuple[tuple[Detection, float], ...] = ()
    alone: bool = False
    anew: bool = False

    @classmethod
    def anew_alone(cls) -> Seeking:
        """A search that begins once more, without the pixels of the other hand."""
        return cls(np.zeros((0, 3)), np.zeros(0), alone=True, anew=True)

    @property
    def over(self) -> bool:
        """Whether all places have been looked at."""
        return not len(self.centres_m) and not self.anew


NOWHERE = LastSeen(torch.zeros(1, 6), math.inf)
"""Before anything was seen."""


@dataclass(frozen=True, eq=False)
class HandState:
    """One hand, in its slot: the track, and what outlives it.

    side: "right" or "left".  handedness: how sure the side is.
    shape: the estimate of the hand's shape.
    track: None while there is no hand to follow.
    seen: the last hand that was believed.
    gesture: smoothed probabilities of the gestures, None where there are none.
    last: the last estimate that there was; lost and NaN before any.
    searched_s: how long ago the whole image was searched for this hand.
    watched: nobody asked for it.
    beside: it was believed while the first hand was, too, so that it is another one.
    seeking: the search for this hand that goes on beside the other one.
    tried: where a track ended last that was never believed.
    """

    side: str
    handedness: HandednessEstimate
    shape: ShapeEstimate
    seen: LastSeen
    last: Estimate
    track: Track | None = None
    gesture: GestureState | None = None
    searched_s: float = math.inf
    watched: bool = False
    beside: bool = False
    seeking: Seeking | None = None
    tried: LastSeen = NOWHERE

    @property
    def believed(self) -> bool:
        """Whether it is a hand that is followed, and not just a place that may be one."""
        return self.track is not None and self.track.believed

    def after(self, dt_s: float) -> HandState:
        """The hand as time goes on."""
        return replace(
            self,
            seen=self.seen.after(dt_s),
            tried=self.tried.after(dt_s),
            searched_s=self.searched_s + dt_s,
        )


@dataclass(frozen=True, eq=False)
class TrackerState:
    """All that is carried between frames: from the same state and images, the same estimates.

    generator: the state of the random generator, as torch.Generator.get_state() gives it.
    hands: one or two, each in its slot.
    watched: nobody asked for the second hand: it is followed so that it is not taken for the first
        one, and not reported.
    second_s: how long ago a second hand was searched for; below 0 while none is.
    merged: how long two tracks have seemed to be on one hand.
    next_index: number of the next frame that comes without one.
    timestamp_s: of the last frame, None before any.
    """

    generator: Tensor
    hands: tuple[HandState, ...]
    watched: bool = False
    second_s: float = math.inf
    merged: Duration = Duration()
    next_index: int = 0
    timestamp_s: float | None = None

    @property
    def reported(self) -> tuple[HandState, ...]:
        """The hands that were asked for."""
        return self.hands[:1] if self.watched else self.hands

    def elapsed_s(self, image: DepthImage) -> float:
        """Seconds from the last frame to an image, as motions are reckoned with."""
        return elapsed_s(self.timestamp_s, image.timestamp_s)

    def at(self, image: DepthImage) -> TrackerState:
        """The state as time goes on to an image."""
        before = image.timestamp_s if self.timestamp_s is None else self.timestamp_s
        passed = max(0.0, image.timestamp_s - before)
        return replace(
            self,
            hands=tuple(hand.after(passed) for hand in self.hands),
            second_s=self.second_s + self.elapsed_s(image),
            next_index=image.index + 1,
            timestamp_s=image.timestamp_s,
        )

    def resumed(self) -> torch.Generator:
        """The random generator, on the CPU."""
        made = torch.Generator()
        made.set_state(self.generator)
        return made


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
