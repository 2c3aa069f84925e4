"""Fitting the user's hand: its components (hand/shape_space.py) from what the networks say of it.

A Gaussian posterior over the components: the population is the prior; every believed frame tells
the hand's length, as the pose network has it, and where the joints are by its keypoints, which is a
Gauss-Newton system of the pose and the components with the pose marginalised (as Tkach et al.,
"Online generative model personalization for hand tracking", SIGGRAPH Asia 2017, do with points).

How much a frame counts falls with the fourth power of the keypoints' standard deviation. On
rendered sequences of other hands the error of the length does so: 3 % in frames of 3.8 mm, 5 % and
more from 4.5 mm on. Frames of one pose and view err alike, so they count once, as a *key pose*; key
poses of one hand err alike too, so that no number of them makes the fit arbitrarily
sure.

Thickness is no part of what joints tell: it keeps the population's mean and spread, but for what
goes with the breadth. It was tried with other evidence (the F-measure, the seen points): one
thickened every hand, the other thinned them all.

A hand that the posterior is sure of is frozen. If the network's lengths disagree with it for long,
by more than it errs, the fit is begun anew: another person's hand, or a wrong fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from torch import Tensor

from toftrack.compute.rotations import rotation_matrix
from toftrack.hand.shape import Fitted, HandShape
from toftrack.hand.shape_space import COMPONENTS, POPULATION_SIGMA
from toftrack.hand.skeleton import CHAIN_SLOTS, JOINT_MOVES, SLOT_BONES, HandPose
from toftrack.refinement.gauss_newton import KEYPOINT_SIGMAS, Keypoints

_COUNT = len(COMPONENTS)
_SURE_M = 0.004
"""Deviation of the keypoints in a frame that counts fully."""
_LENGTH_SIGMA, _KEYPOINTS, _ALIKE = 0.03, 4.0, 0.65
"""In such a frame: error of the network's log length; times that the keypoints count by what the
refinement takes them for; and part of its error that all frames of a hand share."""
_LIKE_ALL = 0.042
"""Part of the error of the fitted log length that is alike in all frames, and that no number of
them makes smaller: with it two standard deviations hold 97 % of 67 fresh hands, else 72 %."""
CERTAIN_POSES = 12.0
"""Different poses seen as surely as that, from which on the shape stays."""
_CONTRADICTION, _MEMORY = 3.5, 20.0
"""The fit is begun anew when the network's lengths are off by so many expected errors over about so
many detections, one in EVERY frames."""
_ANGLE_RAD = 0.25
"""Standard deviation of a refined joint angle where the keypoints are to say it."""
_KEY_RAD, _KEY_TURN_RAD, _KEYS = 0.25, 0.35, 24
"""Poses are another key pose when their angles, rms, or their rotations differ by so much; and key
poses that are kept: then only surer ones come in."""
EVERY = 3
"""Frames from one update to the next: they are alike, and an update costs a millisecond."""
_ENOUGH, _ENOUGH_FRAMES, _SURER = 1.5, 3, 1.2
"""Weight of the frames of a key pose from which on no more are used; or their number, from which on
only frames that count so many times as much are."""
KEYPOINTS_OFF = (0.0, -0.10, 0.0, 0.0, 0.0, 0.0)
"""By how much the keypoints put the components wrong: means of uncertain places shorten fingers.
Of rendered sequences of other hands, like what is said above."""
_SLOTS = list(CHAIN_SLOTS)
_KEY = np.dtype(
    [
        ("angles", "f8", 21),
        ("rotation", "f8", (3, 3)),
        ("frames", "f8"),
        ("weight", "f8"),
        ("square", "f8"),
        ("information", "f8", (_COUNT, _COUNT)),
        ("vector", "f8", _COUNT),
    ]
)
"""What a key pose said of the hand. angles: rad.  frames, weight, square: how many frames it has,
sums of their weights and of the squares.  information, vector: their evidence by its weight's
square: precision, and precision times the components."""
_LEAST = 0.02
"""Weight below which a frame says nothing."""
_STEP, _STEP_SIGMAS = 0.01, 0.5
"""Change of a component for which another hand is made, which costs some milliseconds: at least so
much, and so many of its standard deviations."""


class SeenHand(Protocol):
    """What the pose network says of a hand: its joints, its length, and how probably there is one;
    see detector/detection.py."""

    @property
    def keypoints(self) -> Keypoints: ...

    @property
    def length_m(self) -> float: ...

    @property
    def present(self) -> float: ...


@dataclass(frozen=True, eq=False)
class ShapeEstimate:
    """What is believed of the user's hand.

    mean, covariance: (6,) and (6, 6) of the components.  poses: how many sure, different poses it
    rests on.  keys: (M,) of _KEY, what they said.
    applied: the components of the hand in use, which follows the mean in steps.
    off, considered: by how much the network's log length has differed from the mean lately, summed
    by weight, and the sum of these weights.
    frames: how many were seen, used or not.
    """

    mean: np.ndarray
    covariance: np.ndarray
    keys: np.ndarray
    applied: tuple[float, ...]
    poses: float = 0.0
    off: float = 0.0
    considered: float = 0.0
    frames: int = 0

    @property
    def frozen(self) -> bool:
        """Whether the hand is known so well that no more is learned."""
        return self.poses >= CERTAIN_POSES

    def summary(self) -> Fitted:
        """For the file of the shape."""
        stated = self.covariance.copy()
        stated[0, 0] += _LIKE_ALL**2
        covariance = tuple(tuple(row) for row in stated.tolist())
        return Fitted(COMPONENTS, tuple(self.mean.tolist()), covariance, self.poses, self.frozen)


def first_shape() -> ShapeEstimate:
    """Before any frame was seen: the population."""
    population = np.diag(np.square(POPULATION_SIGMA))
    return ShapeEstimate(np.zeros(_COUNT), population, np.zeros(0, _KEY), (0.0,) * _COUNT)


def with_network_length(
    estimate: ShapeEstimate, length_m: float, first: HandShape
) -> ShapeEstimate:
    """Before any estimate, the length that the network says is applied.

    first: the hand whose components are 0.
    """
    if estimate.poses:
        return estimate
    sigma = POPULATION_SIGMA[0]
    log_length = math.log(length_m / first.hand_length_m)
    applied = min(max(log_length, -3 * sigma), 3 * sigma)
    mean = estimate.mean.copy()
    mean[0] = applied
    return replace(estimate, mean=mean, applied=(applied, *estimate.applied[1:]))


def weight_of(detection: SeenHand) -> float:
    """How much a detection of the hand counts, at most 1."""
    sigma = float(np.sqrt(np.square(detection.keypoints.sigma_m.numpy()).mean()))
    weight = min(1.0, (_SURE_M / max(sigma, 1e-6)) ** 4)
    return weight if math.isfinite(weight) else 0.0


def contradicted(estimate: ShapeEstimate, detection: SeenHand, first: HandShape) -> ShapeEstimate:
    """The estimate after one more frame, believed or not; begun anew where detections disagree."""
    frames = estimate.frames + 1
    if not estimate.poses or frames % EVERY:
        return replace(estimate, frames=frames)
    weight = weight_of(detection) * detection.present
    keep = 1 - 1 / _MEMORY
    log_length = math.log(detection.length_m / first.hand_length_m)
    off = keep * estimate.off + weight * (log_length - float(estimate.mean[0]))
    considered = keep * estimate.considered + weight
    # What a frame of weight 1 errs, of which `_ALIKE` stays however many there are.
    error = _LENGTH_SIGMA**2 * (_ALIKE + (1 - _ALIKE) / max(considered, 1e-9))
    expected = math.sqrt(error + float(estimate.covariance[0, 0]))
    if considered > 1 and abs(off / considered) > _CONTRADICTION * expected:
        return with_network_length(first_shape(), detection.length_m, first)
    return replace(estimate, frames=frames, off=off, considered=considered)


def learned(
    estimate: ShapeEstimate,
    state: Tensor,
    shape: HandShape,
    derivatives: tuple[np.ndarray, np.ndarray],
    detection: SeenHand,
    keypoints: Keypoints,
    first: HandShape,
    posed: Callable[[Tensor], HandPose],
) -> ShapeEstimate:
    """The estimate after a believed estimate; everything on the CPU.

    state: (1, 27).  shape: the hand applied.  derivatives: see shape_derivatives.
    keypoints: the detection's, as the refinement takes them.
    first: the hand whose components are 0.  posed: the forward kinematics of `shape`.
    """
    if estimate.frozen or (estimate.poses and estimate.frames % EVERY):
        return estimate
    weight = weight_of(detection)
    if weight < _LEAST:
        return estimate
    keys = estimate.keys
    angles, rotation = state[0, 6:].numpy(), rotation_matrix(state[0, 3:6].numpy())
    row, known = _nearest(keys, angles, rotation)
    if known and _considered(keys[row], weight):
        return estimate
    if not known and len(keys) == _KEYS:
        sure = keys["square"] / keys["weight"]
        row = int(sure.argmin())
        if sure[row] >= weight:
            return estimate
    information, vector = keypoints_system(posed(state), shape, derivatives, keypoints)
    reported_here = np.subtract(estimate.applied, KEYPOINTS_OFF)
    # The network's length and its keypoints rest on the same image: each counts half.
    vector = 0.5 * _KEYPOINTS * (information @ reported_here + vector)
    information = 0.5 * _KEYPOINTS * information
    precision = 0.5 / _LENGTH_SIGMA**2
    information[0, 0] += precision
    vector[0] += precision * math.log(detection.length_m / first.hand_length_m)
    square = weight**2
    evidence = 1.0, weight, square, square * information, square * vector
    new = np.array((angles, rotation, *evidence), _KEY)
    if not known and len(keys) < _KEYS:
        return _posterior(replace(estimate, keys=np.append(keys, new)))
    keys = keys.copy()
    if known:  # its pose stays that of its first frame
        for name in ("frames", "weight", "square", "information", "vector"):
            keys[name][row] += new[name]
    else:
        keys[row] = new
    return _posterior(replace(estimate, keys=keys))


def _nearest(keys: np.ndarray, angles: np.ndarray, rotation: np.ndarray) -> tuple[int, bool]:
    """The key pose that is most similar to a hand, -1 where there is none; and whether the hand is
    in that pose.
    """
    if not len(keys):
        return -1, False
    bent = np.sqrt(np.square(keys["angles"] - angles).mean(1)) / _KEY_RAD
    cosine = 0.5 * ((keys["rotation"] * rotation).sum((1, 2)) - 1)
    far = np.hypot(bent, np.arccos(cosine.clip(-1, 1)) / _KEY_TURN_RAD)
    row = int(far.argmin())
    return row, bool(far[row] <= 1)


def _considered(key: np.void, weight: float) -> bool:
    """Whether a key pose has said enough for a frame of this weight to add little."""
    often = key["frames"] >= _ENOUGH_FRAMES and weight < _SURER * key["weight"] / key["frames"]
    return bool(key["weight"] > _ENOUGH or often)


def keypoints_system(
    pose: HandPose,
    shape: HandShape,
    derivatives: tuple[np.ndarray, np.ndarray],
    keypoints: Keypoints,
) -> tuple[np.ndarray, np.ndarray]:
    """What keypoints say of the components, the pose of one hand marginalised.

    Returns the precision (6, 6) and the precision times the change of the components (6,).
    """
    # In numpy: on a few numbers each of torch's operations takes longer than its arithmetic.
    points, sigma = keypoints.points_m.numpy(), keypoints.sigma_m.numpy()
    known = np.isfinite(points).all(1) & (sigma > 0)  # what is no number was not found
    gap = pose.joints_m[0].numpy() - np.where(known[:, None], points, 0)
    sigma = np.where(known, sigma, np.inf)
    away = np.square(np.linalg.norm(gap, axis=1) / (KEYPOINT_SIGMAS * sigma))
    weight = (1 / ((1 + away) * sigma)).repeat(3)[:, None]
    by_shape = _joint_derivatives(pose.frames[0].numpy(), *derivatives)
    rows = np.concatenate((_joint_jacobian(pose, shape), by_shape), 1) * weight
    normal, gradient = rows.T @ rows, rows.T @ (gap.ravel() * weight[:, 0])
    angles = np.arange(6, 27)
    normal[angles, angles] += _ANGLE_RAD**-2
    pose_part = normal[:27, :27] + 1e-4 * np.diag(normal[:27, :27].diagonal())
    solved = np.linalg.solve(pose_part, np.column_stack((normal[:27, 27:], gradient[:27])))
    left = normal[27:, :27] @ solved
    return normal[27:, 27:] - left[:, :-1], -(gradient[27:] - left[:, -1])


def _joint_jacobian(pose: HandPose, shape: HandShape) -> np.ndarray:
    """(63, 27) how the joints' coordinates change with translation, rotation about the
    wrist and angles, of one hand.
    """
    frames, origins = pose.frames[0].numpy(), pose.origins_m[0].numpy()
    joints = pose.joints_m[0].numpy().astype(np.float64)
    rest_z = shape.base_frames[:, :, 2].numpy() @ frames[0].T
    x, z = frames[1:, :, 0].reshape(5, 3, 3), frames[1:, :, 2].reshape(5, 3, 3)
    axes = np.stack((rest_z, x[:, 0], z[:, 0], x[:, 1], x[:, 2]), 1).reshape(25, 3)[_SLOTS]
    through = origins[1:].reshape(5, 3, 3)[:, SLOT_BONES].reshape(25, 3)[_SLOTS]
    if shape.side == "left":  # a mirror turns the sense of rotation round
        axes = -axes
    rows = np.zeros((21, 3, 27))
    rows[:, :, :3] = np.eye(3)
    rows[:, :, 3:6] = np.cross(np.eye(3), (joints - origins[0])[:, None]).swapaxes(1, 2)
    turned = np.cross(axes, joints[:, None] - through)
    rows[:, :, 6:] = (turned * JOINT_MOVES[..., None]).swapaxes(1, 2)
    return rows.reshape(63, 27)


def _joint_derivatives(frames: np.ndarray, base: np.ndarray, bones: np.ndarray) -> np.ndarray:
    """(63, 6) how the joints' coordinates change with the components; frames: (16, 3, 3).

    base, bones: (6, 5, 3), see shape_derivatives.
    """
    roots = base @ frames[0].T  # (6, 5, 3)
    along = -bones[..., None] * frames[1:, :, 1].reshape(5, 3, 3)  # (6, 5, 3 bones, 3)
    tips = roots[:, :, None] + along.cumsum(2)
    points = np.concatenate((roots[:, :, None], tips), 2).reshape(_COUNT, 20, 3)
    joints = np.concatenate((np.zeros((_COUNT, 1, 3)), points), 1)
    return joints.reshape(_COUNT, 63).T


def _posterior(estimate: ShapeEstimate) -> ShapeEstimate:
    """Mean, covariance and the hand in use by the key poses that there are."""
    keys = estimate.keys
    each = np.maximum(keys["weight"], 1e-9)
    poses = float((keys["square"] / each).sum())  # sure ones that all of them amount to
    information = (keys["information"] / each[:, None, None]).sum(0)
    vector = (keys["vector"] / each[:, None]).sum(0)
    shared = 1 / (1 + _ALIKE * max(poses - 1, 0.0))
    precision = np.diag(np.square(POPULATION_SIGMA) ** -1) + shared * information
    covariance = np.linalg.inv(precision)
    mean = covariance @ (shared * vector)
    off = np.abs(mean - estimate.applied)
    least = np.maximum(_STEP_SIGMAS * np.sqrt(covariance.diagonal()), _STEP)
    applied = tuple(mean.tolist()) if (off > least).any() else estimate.applied
    return replace(estimate, mean=mean, covariance=covariance, poses=poses, applied=applied)
