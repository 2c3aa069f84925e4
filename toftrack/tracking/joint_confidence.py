"""How far off each joint may be, and whether it is within 40 mm: from signs of its own.

A log-linear model of standard deviations and a logistic one of the probability, both fitted by
toftrack.programs.fit_confidence on rendered sequences. hand/regions.py says along which axes, and
what the deviations mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from toftrack.checks import check_number
from toftrack.errors import ToftrackError
from toftrack.hand.regions import joint_axes
from toftrack.refinement.gauss_newton import Keypoints

JOINT_FEATURES = (
    "unsure",
    "keypoint_off",
    "finger_off",
    "outside",
    "unread",
    "behind",
    "before",
    "misfit",
    "pixel",
    "doubt",
)
"""Signs that a joint is wrong, each a number of order 1 that is larger where it speaks against it:

unsure: the networks' standard deviation of their vote for it, log of centimetres.
vote_off: how far it is from that vote, log of centimetres.
finger_off: the same of the farthest of its finger; at the wrist, the mean of all joints.
outside, unread: parts of its surroundings that are out of the image, or without a reading.
behind, before: how much farther or nearer it is than where it should be below the surface that is
    seen there, in units of 20 mm, 50 mm at most.
misfit: minus the log of the image's score.
pixel: log of a pixel's width there, in millimetres.
doubt: log(1 + exp(-x)) of the log odds x that the whole estimate is right.
"""
KINDS = (
    *("wrist", "thumb_cmc", "thumb_mcp", "thumb_ip", "thumb_tip"),
    *("mcp", "pip", "dip", "tip"),
)
"""Joints that are alike."""
COLUMNS = ("ray", "finger", "across", "odds")
"""What a row of weights is about: log standard deviations in centimetres along three axes, see
hand/regions.py, and the log odds that the joint is within 40 mm."""
KIND_OF_JOINT = np.array([0, 1, 2, 3, 4] + 4 * [5, 6, 7, 8])
"""(21,) rows of KINDS."""
_KEYPOINTS = slice(0, 3)
"""The signs that come from the networks."""
_BELOW_M = np.array([0.012, 0.010, 0.010, 0.008, 0.004] + 4 * [0.010, 0.008, 0.007, 0.004])
"""How far joints are below the surface that a camera sees, roughly."""
_AROUND_M = 0.006
"""Distance of the readings about a joint."""
_GRID_M = _AROUND_M * np.array([(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)], np.float64)
_LEAST_CM, _MOST_CM = 0.1, 30.0
"""Standard deviations are never smaller or larger."""


@dataclass(frozen=True)
class JointConfidence:
    """What makes a joint's standard deviations and probability; see conf/lost/calibrated.yaml.

    scale: times all standard deviations.  odds: added to all log odds.
    kinds: what each kind of joint begins with, in the order of COLUMNS.
    weights: of the signs, likewise.
    """

    scale: float
    odds: float
    kinds: Mapping[str, Sequence[float]]
    weights: Mapping[str, Sequence[float]]

    def __post_init__(self) -> None:
        check_number("lost.joints.scale", self.scale, 0, above=True)
        check_number("lost.joints.odds", self.odds)
        for name, known in (("kinds", KINDS), ("weights", JOINT_FEATURES)):
            rows = getattr(self, name)
            if set(rows) != set(known):
                raise ToftrackError(
                    f"lost.joints.{name} must have a row for each of {', '.join(known)}"
                )
            for key, row in rows.items():
                if isinstance(row, str) or len(row) != len(COLUMNS):
                    raise ToftrackError(
                        f"lost.joints.{name}.{key} must be {len(COLUMNS)} numbers:"
                        f" {', '.join(COLUMNS)}"
                    )
                for value in row:
                    check_number(f"lost.joints.{name}.{key}", value)

    @cached_property
    def _kinds(self) -> np.ndarray:
        return np.array([list(self.kinds[name]) for name in KINDS])[KIND_OF_JOINT]

    @cached_property
    def _weights(self) -> np.ndarray:
        return np.array([list(self.weights[name]) for name in JOINT_FEATURES])

    def judge(self, features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations (21, 3), m, and probabilities (21,) from signs (21, S)."""
        predicted = features @ self._weights + self._kinds
        sigma = (self.scale * np.exp(predicted[:, :3])).clip(_LEAST_CM, _MOST_CM) / 100
        odds = (predicted[:, 3] + self.odds).clip(-30.0, 30.0)
        return sigma.astype(np.float32), (1 / (1 + np.exp(-odds))).astype(np.float32)


def joint_features(
    joints_m: np.ndarray,
    keypoints: Keypoints | None,
    last: np.ndarray | None,
    score: float,
    log_odds: float,
    depth_m: np.ndarray,
    k: np.ndarray,
) -> np.ndarray:
    """(21, S) in the order of JOINT_FEATURES.

    joints_m: (21, 3).  votes: None where the networks did not look in this frame.
    last: (21, S) signs of the frame before, whose votes hold then; one of both must be given.
    score: of the image, 0..1.  log_odds: that the estimate is right.
    depth_m: (H, W), 0 = no reading.  k: (3, 3).
    """
    joints = joints_m.astype(np.float64)
    features = np.empty((len(joints), len(JOINT_FEATURES)))
    if keypoints is None:
        assert last is not None
        features[:, _KEYPOINTS] = last[:, _KEYPOINTS]
    else:
        off = np.linalg.norm(joints - keypoints.points_m.numpy(), axis=1)
        worst = np.concatenate(([off.mean()], off[1:].reshape(5, 4).max(1).repeat(4)))
        features[:, _KEYPOINTS] = _log_cm(np.stack((keypoints.sigma_m.numpy(), off, worst), 1))
    depth = np.maximum(joints[:, 2], 0.05)
    outside, unread, surface = _seen_around(joints[:, :2], depth, depth_m, k)
    deeper = np.where(np.isnan(surface), 0.0, joints[:, 2] - surface - _BELOW_M)
    features[:, 3], features[:, 4] = outside, unread
    features[:, 5], features[:, 6] = deeper.clip(0, 0.05) / 0.02, (-deeper).clip(0, 0.05) / 0.02
    features[:, 7] = -math.log(max(score, 1e-3))
    features[:, 8] = np.log(1e3 * depth / k[0, 0])
    features[:, 9] = np.logaddexp(0.0, -log_odds)
    return features


def propagated_sigma(
    joints_m: np.ndarray, covariance: Tensor, joints_of: Callable[[Tensor], Tensor]
) -> np.ndarray:
    """(21, 3) m along joint_axes: what the particles' covariance means for the joints (21, 3).

    covariance: (6 + d, 6 + d) in the tangent space.
    joints_of: joints (N, 21, 3) of the estimate moved by tangents (N, 6 + d).
    """
    size = len(covariance)
    # One step along each main axis and back; a covariance may be singular, so no Cholesky.
    values, vectors = torch.linalg.eigh(covariance.double())
    steps = (vectors * values.clamp(min=0).sqrt()).mT.to(covariance.dtype)
    moved = joints_of(torch.cat((steps, -steps))).cpu().double().numpy()
    half = 0.5 * (moved[:size] - moved[size:])
    along = np.einsum("jab,njb->nja", joint_axes(joints_m), half)
    sigma: np.ndarray = np.sqrt(np.square(along).sum(0)).astype(np.float32)
    return sigma


def _seen_around(
    xy_m: np.ndarray, z_m: np.ndarray, depth_m: np.ndarray, k: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What is seen about points: parts outside, parts without reading, median depth or NaN; (N,).

    xy_m: (N, 2).  z_m: (N,), above 0.
    """
    height, width = depth_m.shape
    focal, middle = k[[0, 1], [0, 1]], k[[0, 1], [2, 2]]
    pixels = (xy_m[:, None] + _GRID_M) * (focal / z_m[:, None, None]) + middle
    column, row = np.rint(pixels.clip(-1e6, 1e6)).astype(np.int64).transpose(2, 0, 1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    seen = depth_m[row.clip(0, height - 1), column.clip(0, width - 1)]
    read = inside & (seen > 0)
    # The lower middle of what was read; nanmedian takes ten times as long.
    ordered = np.sort(np.where(read, seen, np.inf), 1)
    count = read.sum(1)
    median = ordered[np.arange(len(count)), np.maximum(count - 1, 0) // 2]
    inside_count = inside.sum(1)
    unread = (inside_count - count) / len(_GRID_M)
    return 1 - inside_count / len(_GRID_M), unread, np.where(count > 0, median, np.nan)


def _log_cm(metres: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(100 * metres, 0.05))
