"""The posterior of a hand's pose, by which all but the particle filter compare poses.

    log p(pose | frame) = image + keypoints + overlap + other hand  (up to a constant)

`View.log_posterior` adds them up: a start, the hypotheses of a frame and the two sides of a hand
are compared by it; the filter weighs its particles by the image alone, sharpened.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.compiling import entry_point
from toftrack.compute.rigid_numba import distance
from toftrack.compute.transfer import on_device, on_host
from toftrack.errors import check_number
from toftrack.refinement.gauss_newton import Keypoints
from toftrack.render.likelihood import Likelihood, checked_score
from toftrack.render.scoring import Counts, Evidence, Scorer

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
    """The likelihood of the image: the log of the F-measure, and of how much is explained.

    evidence_of: makes the evidence, on the scorer's device, when it is first asked for.
    coverage: weight of how much is explained; None = the likelihood's own.
    """

    likelihood: Likelihood
    scorer: Scorer
    evidence_of: Callable[[], Evidence]
    device: torch.device
    coverage: float | None = None

    @property
    def evidence(self) -> Evidence:
        """What poses are compared with."""
        return self.evidence_of()

    def __call__(self, poses: Tensor) -> Tensor:
        """(N,) log values of poses (N, 27), all on the CPU."""
        return self.likelihood.log_score(self._counts(poses), self.coverage)

    def score(self, pose: Tensor) -> float:
        """The F-measure, 0 .. 1, of a pose (1, 27); ToftrackError where it is none."""
        return float(checked_score(self.likelihood, self._counts(pose)))

    def _counts(self, poses: Tensor) -> Counts:
        return Counts(*on_host(*self.scorer(on_device(poses, self.device), self.evidence)))


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
