"""A detection: what the pose network says of the hand at one place."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.rigid import pivot_offset
from toftrack.detector.parts import ALL_HAND, Parts
from toftrack.hand.overlap import overlap_of_each
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M
from toftrack.refinement.gauss_newton import Keypoints

_DOUBT_M = 0.06
"""Standard deviation that is added to a finger's outer joints where it lies wholly in another."""
_OUTER = np.array([0, 1, 1, 1], np.float32)
"""Which of a finger's four joints are outer ones, which may belong to another finger."""
_CLEAR_M = 0.010
"""Expected error that counts as much as a factor e in probability."""


@dataclass(frozen=True, eq=False)
class Detection:
    """What the pose network says of the hand at one place, likeliest hypothesis first.

    pivot_m, rotvec, angles: (H, 3), (H, 3), (H, 21).  joints_m: (H, 21, 3) of a hand of that size.
    log_size: (H,) of the hand's length in units of the mean adult's.
    log_probability, error_m: (H,).
    keypoints: the joints, each with its standard deviation.
    present, right_side: probabilities that there is a hand, and that it is of the side looked for.
    parts: which of the pixels are the hand, and which a thing's that it holds.
    heat: the finder's probability of a hand there; 1 where the finder was not asked.
    """

    pivot_m: Tensor
    rotvec: Tensor
    angles: Tensor
    joints_m: Tensor
    log_size: Tensor
    log_probability: Tensor
    error_m: Tensor
    keypoints: Keypoints
    present: float
    right_side: float
    parts: Parts = ALL_HAND
    heat: float = 1.0

    @cached_property
    def merit(self) -> float:
        """How much speaks for a hand of the side that was looked for, log scale."""
        odds = math.log(max(self.heat, 1e-6)) + math.log(max(self.present, 1e-6))
        odds += 0.5 * math.log(max(self.right_side, 1e-3))
        # How far off the pose network takes itself to be.
        doubt_m = float(self.error_m[0]) + 0.5 * float(self.keypoints.sigma_m.mean())
        return odds - doubt_m / _CLEAR_M

    def states(self, ratio: float, count: int | None = None) -> Tensor:
        """(H, 27) the hypotheses as poses of a hand of `ratio` times the mean adult's length, with
        the middle of the palm where it is.

        count: how many hypotheses at most; None = all.
        """
        pivot, rotvec = self.pivot_m.numpy()[:count], self.rotvec.numpy()[:count]
        states = np.empty((len(rotvec), 27), np.float32)
        states[:, 3:6], states[:, 6:] = rotvec, self.angles.numpy()[:count]
        states[:, :3] = pivot - np.float32(ratio) * pivot_offset(rotvec)
        return torch.from_numpy(states)

    @property
    def empty(self) -> bool:
        """Whether nothing was said; see NO_DETECTION."""
        return not len(self.rotvec)

    @property
    def length_m(self) -> float:
        """The hand's length, the mean of the hypotheses'."""
        weights = self.log_probability.softmax(0)
        return DEFAULT_HAND_LENGTH_M * float((weights * self.log_size).sum().exp())

    @property
    def centre_m(self) -> Tensor:
        """(3,) middle of the palm of the likeliest hypothesis."""
        return self.pivot_m[0]

    @property
    def up(self) -> np.ndarray:
        """(3,) m from the wrist to the middle finger's knuckle: where the fingers point."""
        wrist, knuckle = self.keypoints.points_m[[0, 9]].numpy()
        return np.asarray(knuckle - wrist)


OF_HYPOTHESES: dict[str, tuple[int, ...]] = {
    "pivot_m": (3,),
    "rotvec": (3,),
    "angles": (21,),
    "joints_m": (21, 3),
    "log_size": (),
    "log_probability": (),
    "error_m": (),
}
"""Fields that have a row for each hypothesis, in the order in which the compiled code writes them,
and the shapes of their rows."""
_NONE: dict[str, Any] = {name: torch.zeros(0, *row) for name, row in OF_HYPOTHESES.items()}
NO_DETECTION = Detection(
    **_NONE,
    keypoints=Keypoints(torch.zeros(21, 3), torch.full((21,), torch.inf)),
    present=0.0,
    right_side=0.5,
)
"""Of a frame in which the network was not asked, or found no hand."""


def doubted_sigma_m(points_m: Tensor, sigma_m: Tensor, hand_length_m: float) -> Tensor:
    """(21,) deviations of keypoints (21, 3): larger where those of two fingers coincide.

    Of a single finger that is seen the cells do not know which one it is, and say surely that it is
    either; what is no hand, such as an elbow, has its fingers in one another.
    """
    # In numpy: on a few numbers each of torch's operations takes longer than its arithmetic.
    overlap = overlap_of_each(points_m[None], hand_length_m)[0].numpy()
    doubt_m = _DOUBT_M * np.minimum(overlap, 1)[:, None] * _OUTER
    sigma = sigma_m.numpy().copy()
    sigma[1:] = np.hypot(sigma[1:], doubt_m.ravel())
    return torch.from_numpy(sigma)
