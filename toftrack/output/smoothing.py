"""The One Euro filter on estimates: calm when the hand is slow, quick when it is fast.

Casiez, Roussel and Vogel, "1 Euro Filter: A Simple Speed-based Low-pass Filter for Noisy Input in
Interactive Systems", CHI 2012: a first-order low-pass whose cut-off rises with the speed,

    cutoff = min_cutoff + beta |speed|,

where the speed is low-passed itself, with a fixed cut-off. Here the *hand* is filtered, not each
joint by itself: the wrist's position with one cut-off for its three axes, so that the result does
not depend on how the camera is turned; the rotation on SO(3); and each of the 21 joint angles. The
joints follow by forward kinematics, so bones keep their lengths and angles their limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from toftrack.compute.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from toftrack.errors import check_number
from toftrack.frames.estimate import Estimate
from toftrack.gestures.recognition import pointing_ray
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import forward_kinematics


@dataclass(frozen=True)
class OneEuro:
    """The filter's settings; see conf/smooth/one_euro.yaml for what each does."""

    min_cutoff_hz: float
    position_beta: float
    rotation_beta: float
    angle_beta: float
    speed_cutoff_hz: float
    results: bool

    def __post_init__(self) -> None:
        for name in ("min_cutoff_hz", "speed_cutoff_hz"):
            check_number(f"smooth.{name}", getattr(self, name), 0, above=True, remedy=" hertz")
        for name in ("position_beta", "rotation_beta", "angle_beta"):
            same = " (0 = the same cut-off at any speed)"
            check_number(f"smooth.{name}", getattr(self, name), 0, remedy=same)


def no_smoothing() -> None:
    """Estimates as the tracker makes them: smooth=none."""


_Parts = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Position (3,) m, rotation (3, 3), and angles (21,) rad."""


@dataclass(frozen=True, eq=False)
class SmoothState:
    """What is carried from frame to frame.

    speed: of position (3,) m/s, rotation (3,) rad/s in the hand's frame, and angles (21,) rad/s;
    smooth, too.
    """

    timestamp_s: float
    raw: _Parts
    smooth: _Parts
    speed: _Parts


def smooth(
    settings: OneEuro | None, state: SmoothState | None, estimate: Estimate, shape: HandShape
) -> tuple[SmoothState | None, Estimate]:
    """One frame on: the new state, and the estimate with `state`, `joints_m` and pointing smoothed;
    its other fields speak of the estimate as it was.

    Time is that of the frames' time stamps, so dropped frames and uneven intervals do no harm. An
    estimate of a hand that is not followed (lost, being recovered, or never found) passes as it is,
    and the filter starts anew with the next one that is; so it does at the start of a track (state
    None), and when time stands still or goes back. Without settings everything passes as it is.
    """
    followed = estimate.state_name == "tracking" and np.isfinite(estimate.state).all()
    starts = estimate.state_name == "initialising" and not estimate.lost
    if settings is None or not (followed or starts):
        return None, estimate
    vector, time_s = estimate.state.astype(np.float64), estimate.timestamp_s
    raw = vector[:3], _exp(vector[3:6]), vector[6:]
    if state is None or starts or not time_s > state.timestamp_s:
        return SmoothState(time_s, raw, raw, (np.zeros(3), np.zeros(3), np.zeros(21))), estimate
    seconds = time_s - state.timestamp_s
    slow = _share(settings.speed_cutoff_hz, seconds)
    now = (way / seconds for way in _ways(state.raw, raw))
    velocity, turning, bending = (
        before + slow * (new - before) for before, new in zip(state.speed, now, strict=True)
    )
    speeds = (
        settings.position_beta * float(np.linalg.norm(velocity)),
        settings.rotation_beta * float(np.linalg.norm(turning)),
        settings.angle_beta * np.abs(bending),
    )
    shares = (_share(settings.min_cutoff_hz + faster, seconds) for faster in speeds)
    ways = _ways(state.smooth, raw)
    moved, turned, bent = (share * way for share, way in zip(shares, ways, strict=True))
    position, rotation, angles = state.smooth
    calm = position + moved, rotation @ _exp(turned), angles + bent
    state = SmoothState(time_s, raw, calm, (velocity, turning, bending))
    vector = np.concatenate((calm[0], _log(calm[1]), calm[2]))
    return state, _with_state(estimate, vector.astype(np.float32), shape)


def _with_state(estimate: Estimate, state: np.ndarray, shape: HandShape) -> Estimate:
    """The estimate with another hand state, (27,), and what follows from it."""
    hand = torch.from_numpy(state)[None]
    joints = forward_kinematics(hand, shape.to("cpu", torch.float32)).joints_m[0].numpy()
    estimate = estimate.updated(state=state, joints_m=joints)
    if np.isfinite(estimate.pointing_origin_m).all():
        origin, direction = pointing_ray(joints)
        estimate = estimate.updated(pointing_origin_m=origin, pointing_direction=direction)
    return estimate


def _share(cutoff_hz: np.ndarray | float, seconds: float) -> np.ndarray | float:
    """How much of the new value a low-pass takes over that was last fed `seconds` ago."""
    return 1.0 / (1.0 + 1.0 / (2.0 * math.pi * cutoff_hz * seconds))


def _ways(before: _Parts, now: _Parts) -> _Parts:
    """From one hand to another; of the rotation as a vector (3,)."""
    return now[0] - before[0], _log(before[1].T @ now[1]), now[2] - before[2]


def _exp(vector: np.ndarray) -> np.ndarray:
    """(3,) rotation vector to (3, 3)."""
    return rotvec_to_rotmat(torch.from_numpy(vector)).numpy()


def _log(rotation: np.ndarray) -> np.ndarray:
    """(3, 3) to the (3,) rotation vector."""
    return rotmat_to_rotvec(torch.from_numpy(rotation)).numpy()
