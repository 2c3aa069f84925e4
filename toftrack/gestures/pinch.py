"""How nearly the thumb and the index finger touch, and whether they pinch.

The gap is between the surfaces of the two fingertips: from the centre of each tip's rounded end, a
radius short of its end on the last phalanx's axis, less both radii. So pads that lie on each other
and tips that meet count alike. It is measured in lengths of the hand, and is the same for a child.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from toftrack.compute.compiling import entry_point
from toftrack.compute.rigid_numba import distance
from toftrack.errors import ToftrackError, check_number
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.hand.surface import hand_surface

_THUMB, _INDEX = (JOINT_NAMES.index(n) for n in ("thumb_tip", "index_tip"))
_MIDDLE = JOINT_NAMES.index("middle_mcp")
_LAST_BONES = 3, 6
"""Frames of the last bones of thumb and index finger, see hand.skeleton.HandPose."""
_ENDS = [_THUMB - 1, _THUMB, _INDEX - 1, _INDEX]


@dataclass(frozen=True)
class PinchSettings:
    """What counts as a pinch; see conf/gestures for what each does."""

    touching: float
    open: float
    begin: float
    end: float
    frames: float

    def __post_init__(self) -> None:
        if not -math.inf < self.touching < self.open < math.inf:
            raise ToftrackError("gestures.pinch.touching must be below gestures.pinch.open")
        if not 0 <= self.end < self.begin <= 1:
            raise ToftrackError(
                "gestures.pinch.end must be below gestures.pinch.begin, both in 0 .. 1"
            )
        check_number("gestures.pinch.frames", self.frames, 0)


@dataclass(frozen=True)
class PinchState:
    """What is carried from frame to frame.

    pinching: as reported.  against: for how many times 1/25 s the pinch has said otherwise.
    """

    pinching: bool = False
    against: float = 0.0


@functools.cache
def _tip_radii() -> tuple[float, float]:
    """Half the depth of the last phalanges of thumb and index finger, in lengths of the hand."""
    shape = default_hand_shape()
    surface = hand_surface(shape)
    thumb, index = (
        float(surface.axes_m[surface.frame_index == bone][0, 2, 2]) / shape.hand_length_m
        for bone in _LAST_BONES
    )
    return thumb, index


@entry_point
def gap_between(joints, thumb, index):
    """Between the surfaces of thumb tip and index tip; below 0 in overlap.

    joints: (21, 3).  thumb, index: radii of the tips; like the gap in lengths of the hand.
    """
    length = distance(joints[0], joints[_MIDDLE])
    for joint in range(_MIDDLE, _MIDDLE + 3):
        length += distance(joints[joint], joints[joint + 1])
    ends = np.empty((2, 3))
    for n, tip, radius in ((0, _THUMB, thumb), (1, _INDEX, index)):
        part = radius * length / distance(joints[tip], joints[tip - 1])
        for i in range(3):
            ends[n, i] = joints[tip, i] - part * (joints[tip, i] - joints[tip - 1, i])
    return distance(ends[0], ends[1]) / length - thumb - index


def pinch_of(
    joints_m: np.ndarray, settings: PinchSettings, joint_ok: np.ndarray | None = None
) -> float:
    """0 open .. 1 touching; NaN where a joint of the two last bones is not ok.

    joints_m: (21, 3) metres.  joint_ok: (21,) bool; None: all are.
    """
    if joint_ok is not None and not joint_ok[_ENDS].all():
        return math.nan
    gap = float(gap_between(joints_m, *_tip_radii()))
    part = (settings.open - gap) / (settings.open - settings.touching)
    return min(max(part, 0.0), 1.0)


def update_pinch(
    state: PinchState, pinch: float, settings: PinchSettings, frames: float = 1.0
) -> PinchState:
    """One frame on: a pinch begins and ends at two thresholds, and only when it stays beyond one.
    One that nobody knows (NaN) begins none, and ends what it outlasts.

    frames: how many times 1/25 s have passed since the state.
    """
    ends = math.isnan(pinch) or pinch < settings.end
    beyond = ends if state.pinching else pinch >= settings.begin
    if not beyond:
        return PinchState(state.pinching)
    against = state.against + frames
    if against < settings.frames:
        return PinchState(state.pinching, against)
    return PinchState(not state.pinching)
