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

from toftrack.checks import check_number
from toftrack.compute.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from toftrack.estimate import Estimate
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


@dataclass(frozen=True, eq=False)
class SmoothState:
    """What is carried from frame to frame.

    position: (3,) m.  rotation: (3, 3).  angles: (21,) rad.  All three (raw, smooth).
    velocity: (3,) m/s.  turning: (3,) rad/s, in the hand's frame.  bending: (21,) rad/s. Smooth.
    """

    timestamp_s: float
    position: tuple[np.ndarray, np.ndarray]
    rotation: tuple[np.ndarray, np.ndarray]
    angles: tuple[np.ndarray, np.ndarray]
    velocity: np.ndarray
    turning: np.ndarray
    bending: np.ndarray


def smooth(
    settings: OneEuro | None, state: SmoothState | None, estimate: Estimate, shape: HandShape
) -> tuple[SmoothState | None, Estimate]:
    """One frame on: the new state, and the estimate with `state`, `joints_m` and pointing smoothed.

    Its other fields stay: covariance, latent, score, gesture and pinch speak of the estimate as it
    was.
    Time is that of the frames' time stamps, so dropped frames and uneven intervals do no harm.

    An estimate of a hand that is not followed (lost, being recovered, or never found) passes as it
    is, and the filter starts anew with the next one that is; so it does at the start of a track,
    and when time stands still or goes back.

    settings: None passes everything as it is.
    state: of the frame before; None at the start.
    shape: the hand of the estimate.
    """
    followed = estimate.state_name == "tracking" and np.isfinite(estimate.state).all()
    starts = estimate.state_name == "initialising" and not estimate.lost
    if settings is None or not (followed or starts):
        return None, estimate
    raw = estimate.state.astype(np.float64)
    position, angles = raw[:3], raw[6:]
    rotation = _exp(raw[3:6])
    if state is None or starts or not estimate.timestamp_s > state.timestamp_s:
        pairs = ((position,) * 2, (rotation,) * 2, (angles,) * 2)
        still = (np.zeros(3), np.zeros(3), np.zeros(len(angles)))
        return SmoothState(estimate.timestamp_s, *pairs, *still), estimate

    seconds = estimate.timestamp_s - state.timestamp_s
    slow = _share(settings.speed_cutoff_hz, seconds)
    velocity = _mix(state.velocity, (position - state.position[0]) / seconds, slow)
    turning = _mix(state.turning, _log(state.rotation[0].T @ rotation) / seconds, slow)
    bending = _mix(state.bending, (angles - state.angles[0]) / seconds, slow)

    def share(beta: float, speed: np.ndarray | float) -> np.ndarray | float:
        return _share(settings.min_cutoff_hz + beta * speed, seconds)

    before = state.position[1], state.rotation[1], state.angles[1]
    there = share(settings.position_beta, float(np.linalg.norm(velocity)))
    turned = share(settings.rotation_beta, float(np.linalg.norm(turning)))
    bent = share(settings.angle_beta, np.abs(bending))
    smooth_position = _mix(before[0], position, there)
    smooth_rotation = before[1] @ _exp(turned * _log(before[1].T @ rotation))
    smooth_angles = _mix(before[2], angles, bent)
    state = SmoothState(
        estimate.timestamp_s,
        (position, smooth_position),
        (rotation, smooth_rotation),
        (angles, smooth_angles),
        velocity,
        turning,
        bending,
    )
    vector = np.concatenate((smooth_position, _log(smooth_rotation), smooth_angles))
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


def _mix(before: np.ndarray, now: np.ndarray, share: np.ndarray | float) -> np.ndarray:
    return before + share * (now - before)


def _exp(vector: np.ndarray) -> np.ndarray:
    """(3,) rotation vector to (3, 3)."""
    return rotvec_to_rotmat(torch.from_numpy(vector)).numpy()


def _log(rotation: np.ndarray) -> np.ndarray:
    """(3, 3) to the (3,) rotation vector."""
    return rotmat_to_rotvec(torch.from_numpy(rotation)).numpy()
