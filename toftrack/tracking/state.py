"""What the tracker carries from frame to frame, and what others may see of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from toftrack.detector.hand_detector import Detection
from toftrack.estimate import Estimate
from toftrack.frames import DepthImage
from toftrack.gestures.recognition import GestureState
from toftrack.render.segmentation import Expected, Observation
from toftrack.tracking.features import ConfidenceFeatures
from toftrack.tracking.handedness_estimate import HandednessEstimate
from toftrack.tracking.prior import LastSeen
from toftrack.tracking.shape_fit import ShapeEstimate


@dataclass(frozen=True, eq=False)
class Contender:
    """A pose with other fingers that has been better than the track's.

    pose: (1, 27).  lead: by how much, log scores summed up over frames.
    """

    pose: Tensor
    lead: float


@dataclass(frozen=True, eq=False)
class Track:
    """A hand that is followed.

    particles: (N, 6 + d), after the last observation.  weights: (N,) normalised. Both are on the
        model's device; all else is on the CPU.
    mean: (1, 6 + d), the last estimate in the pose space.  velocity: (6 + d,) its change a second.
    offset: (21,) rad, by how much the refined pose lies off the pose space; all hypotheses are
        displaced by it.
    pose: (1, 27) the last estimate; at the start, what the track begins with.
    trend: (27,) its mean change a second, see steadying.
    contender: another pose that may take its place, None where there is none.
    age_s: how long it has been followed, 0 before the first frame.
    bad_s: how long it has been doubted much. The first frame counts FRAME_S, so that one alone says
        the same at any rate.
    challenged_s: how long a pose of the networks has been better.
    log_odds: that the estimate is right, smoothed over time; None where nobody says.
    doubted: the last estimate was flagged lost.  believed: one of its estimates was not.
    unlooked_s: how long ago the networks looked at it.  signs: of the last estimate.
    joint_signs: (21, S) likewise, see JOINT_FEATURES; None where there are none.
    expected: depths where the hand was looked for in the last frame, if something hid part of it.
    """

    particles: Tensor
    weights: Tensor
    mean: Tensor
    velocity: Tensor
    offset: Tensor
    pose: Tensor
    trend: Tensor | None = None
    contender: Contender | None = None
    age_s: float = 0.0
    bad_s: float = 0.0
    challenged_s: float = 0.0
    log_odds: float | None = None
    doubted: bool = False
    believed: bool = False
    undetected_time_s: float = 0.0
    features: ConfidenceFeatures | None = None
    joint_features: np.ndarray | None = None
    expected: Expected | None = None


@dataclass(frozen=True, eq=False)
class TrackerState:
    """All that is carried between frames: from the same state and images, the same estimates.

    generator: the state of the random generator, as torch.Generator.get_state() gives it.
    side: "right" or "left", whose hand is followed.
    size: what is believed of the hand's shape.
    sides: how sure the side is; None where it was told.
    track: None while there is no hand to follow.
    seen: the last hand that was believed.
    gesture: smoothed probabilities of the gestures.
    last: the last estimate that there was.
    unsearched_s: how long ago the whole image was searched for a hand.
    next_index: number of the next frame that comes without one.
    timestamp_s: of the last frame.
    """

    generator: Tensor
    side: str
    size: ShapeEstimate
    sides: HandednessEstimate | None = None
    track: Track | None = None
    seen: LastSeen | None = None
    gesture: GestureState | None = None
    last: Estimate | None = None
    search_age_s: float = math.inf
    next_index: int = 0
    timestamp_s: float | None = None

    def at(self, image: DepthImage) -> TrackerState:
        """The state as time goes on to an image."""
        before, seen = self.timestamp_s, self.seen
        passed = 0.0 if before is None else max(0.0, image.timestamp_s - before)
        return replace(
            self,
            seen=None if seen is None else replace(seen, age_s=seen.age_s + passed),
            search_age_s=self.search_age_s + passed,
            next_index=image.index + 1,
            timestamp_s=image.timestamp_s,
        )


@dataclass(frozen=True, eq=False)
class StepInfo:
    """What a step saw and believed; for those who watch it.

    particles: (N, 6 + d) before the estimate was refined; none where nothing can be a hand.
    weights: (N,) normalised. Both are on the model's device.
    seconds: wall seconds of each stage.
    signs, joint_signs: what the beliefs were formed from; None where there are no networks.
    glance: what the networks saw; None where they did not look.
    """

    observation: Observation
    particles: Tensor
    weights: Tensor
    seconds: Mapping[str, float]
    features: ConfidenceFeatures | None = None
    joint_features: np.ndarray | None = None
    detection: Detection | None = None


def resumed(generator: Tensor) -> torch.Generator:
    """The random generator of a state, on the CPU."""
    made = torch.Generator()
    made.set_state(generator)
    return made


def generator_on(device: torch.device, generator: torch.Generator) -> torch.Generator:
    """The generator to draw particles with on a device; on the CPU it is the given one itself.

    Elsewhere the given one seeds it, so that nothing but the CPU's is carried between frames.
    """
    if device.type == "cpu":
        return generator
    seed = int(torch.randint(2**62, (1,), generator=generator))
    return torch.Generator(device).manual_seed(seed)
