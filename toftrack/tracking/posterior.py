"""The posterior of a hand's pose, by which all but the particle filter compare poses.

    log p(pose | frame) = image + keypoints + overlap + other hand  (up to a constant)

`View.log_posterior` adds them up: a start, the hypotheses of a frame and the two sides of a hand
are compared by it; the filter weighs its particles by the image alone, sharpened.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.compiling import entry_point
from toftrack.compute.rigid_numba import distance
from toftrack.compute.transfer import on_device, on_host
from toftrack.errors import check_number
from toftrack.refinement.gauss_newton import Keypoints
from toftrack.render.likelihood import checked_score
from toftrack.render.scoring import Counts, Evidence, Scorer
from toftrack.render.segmentation import Observation

if TYPE_CHECKING:
    from toftrack.tracking.model import FilterModel

_FAR_SIGMAS = 3.0
"""Scale, in standard deviations, from which on farther joints hardly cost more."""
_TOUCH_M = 0.018
"""Joints of two hands come no nearer to each other, as a rule: fingers are so thick."""


@dataclass(frozen=True)
class PosteriorWeights:
    """The weights of the posterior's terms, see conf/posterior; a term of weight 0 is left out.

    overlap: of fingers in one another. Else what is no hand, such as an elbow, looks like one with
        overlapping fingers: without this term one recording was lost (docs/lab/ablation.md).
    """

    keypoints: float
    overlap: float
    other_hand: float

    def __post_init__(self) -> None:
        for entry in fields(self):
            check_number(f"posterior.{entry.name}", getattr(self, entry.name), 0, 1e6)


@dataclass(frozen=True, eq=False)
class ImageTerm:
    """The likelihood of an observation: the log of the F-measure, and of how much is explained.

    observation: not empty.  scorer: of the hand in its shape.
    coverage: weight of how much is explained; None = the likelihood's own.
    """

    model: FilterModel
    observation: Observation
    scorer: Scorer
    coverage: float | None = None

    @property
    def evidence(self) -> Evidence:
        """What poses are compared with, on the particles' device; made when first asked for."""
        return self.model.evidence(self.observation)

    def __call__(self, poses: Tensor) -> Tensor:
        """(N,) log likelihoods of poses (N, 27), all on the CPU."""
        return self.model.likelihood.log_score(self._counts(poses), self.coverage)

    def score(self, pose: Tensor) -> float:
        """The F-measure, 0 .. 1, of a pose (1, 27).

        Raises ToftrackError where a likelihood of somebody else returns no such number.
        """
        return float(checked_score(self.model.likelihood, self._counts(pose)))

    def _counts(self, poses: Tensor) -> Counts:
        return Counts(*on_host(*self.scorer(on_device(poses, self.model.device), self.evidence)))


def keypoints_off(joints_m: Tensor, keypoints: Keypoints) -> Tensor:
    """(N,) how far joints (N, 21, 3) are from keypoints: the mean of their squared deviations in
    standard deviations, robust (Geman-McClure).
    """
    # In numpy: on a few poses each of torch's operations takes longer than its arithmetic.
    away = joints_m.numpy() - keypoints.points_m.numpy()
    off = np.square(away).sum(-1) / np.square(keypoints.sigma_m.numpy())
    return torch.from_numpy((off / (1 + off / _FAR_SIGMAS**2)).mean(1))


def touching(joints_m: Tensor, other_m: Tensor) -> Tensor:
    """(N,) how much of hands (N, 21, 3) lies in another one (J, 3), 0 .. 1."""
    found = np.empty(len(joints_m), np.float32)
    _touch(joints_m.numpy(), other_m.numpy(), found)
    return torch.from_numpy(found)


@entry_point
def _touch(joints, other, found):
    """See touching."""
    for n in range(len(joints)):
        total = 0.0
        for j in range(joints.shape[1]):
            nearest = _TOUCH_M
            for i in range(len(other)):
                nearest = min(nearest, distance(joints[n, j], other[i]))
            total += 1 - nearest / _TOUCH_M
        found[n] = total / joints.shape[1]
