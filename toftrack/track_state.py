"""What the tracker carries from frame to frame, when it says that it has lost the hand, and what
others may see of it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from toftrack.render.segmentation import Expected, Observation

_APPROACH_M = 0.002
"""How much nearer than its middle's movement a partly hidden hand may come in a frame."""


@dataclass(frozen=True)
class LostSettings:
    """When the tracker says that it has lost the hand; see conf/lost for what each does."""

    score: float
    patience: int
    start_score: float
    probation: int
    rival_gain: float
    outside_rad: float


@dataclass(frozen=True)
class TrackState:
    """What the tracker carries from frame to frame.

    particles: (N, 6 + d), after the last observation.  weights: (N,) normalised.
    mean: (1, 6 + d), the last estimate in the pose space.  velocity: (6 + d,) its change a frame.
    state: (1, 27) the last refined hand, None at the start.
    trend: (27,) its mean change a frame, see steadying.
    offset: (21,) rad, by how much the refined pose lies off the pose space; all hypotheses are
        displaced by it.
    age: frames since the start.  bad: frames in a row with a low score.
    outside: frames in a row out of the pose space.
    expected: depths where the hand was looked for in the last frame, if something hid part of it.
    """

    particles: Tensor
    weights: Tensor
    mean: Tensor
    velocity: Tensor
    offset: Tensor
    state: Tensor | None = None
    trend: Tensor | None = None
    age: int = 0
    bad: int = 0
    outside: int = 0
    expected: Expected | None = None


def expected_depths(track: TrackState, joints_m: Tensor) -> Expected:
    """Where the next frame is looked for a hand whose joints (21, 3) are expected in it."""
    nearest, farthest = map(float, joints_m[:, 2].aminmax())
    if track.expected is not None:
        # A hidden finger is free to move in front of what hides it, which would then be taken for
        # the hand: while something hides the hand, it comes nearer only as its middle does.
        approach = _APPROACH_M + max(0.0, -float(track.velocity[2]))
        nearest = max(nearest, track.expected.nearest_m - approach)
    return Expected(nearest, farthest)


@dataclass(frozen=True, eq=False)
class Insight:
    """What the tracker saw and believed in a frame, on its own device; for those who watch it.

    particles: (N, 6 + d) before the estimate was refined.  weights: (N,) normalised.
    """

    observation: Observation
    particles: Tensor
    weights: Tensor
