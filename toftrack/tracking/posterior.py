"""The posterior of a hand's pose, by which all but the particle filter compare poses.

    log p(pose | frame) = image + keypoints + overlap + other hand  (up to a constant)

A start, the hypotheses of a frame and the two sides of a hand are compared by it; the filter weighs
its particles by the image alone, sharpened. A term of weight 0 is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields

import numpy as np
import torch
from torch import Tensor

from toftrack.checks import check_number
from toftrack.compute.transfer import on_device, on_host
from toftrack.hand.overlap import finger_overlap
from toftrack.refinement.gauss_newton import Keypoints
from toftrack.render.likelihood import FMeasure
from toftrack.render.scoring import Counts, Evidence, Scorer

_FAR_SIGMAS = 3.0
"""Scale, in standard deviations, from which on farther joints hardly cost more."""
_TOUCH_M = 0.018
"""Joints of two hands come no nearer to each other, as a rule: fingers are so thick."""
Term = Callable[[Tensor, Tensor], Tensor]
"""Log values (N,) of poses (N, 27) and their joints (N, 21, 3); everything on the CPU."""


@dataclass(frozen=True)
class PosteriorWeights:
    """The weights of the posterior's terms; see conf/posterior for what each does."""

    keypoints: float
    overlap: float
    other_hand: float

    def __post_init__(self) -> None:
        for entry in fields(self):
            check_number(f"posterior.{entry.name}", getattr(self, entry.name), 0)


@dataclass(frozen=True, eq=False)
class ImageTerm:
    """The likelihood of the image: the log of the F-measure, and of how much is explained.

    evidence: on the scorer's device.  coverage: weight of how much is explained; None = the
        likelihood's own.
    """

    likelihood: FMeasure
    scorer: Scorer
    evidence: Evidence
    device: torch.device
    coverage: float | None = None

    def __call__(self, poses: Tensor) -> Tensor:
        """(N,) log values of poses (N, 27), on the device of the poses: the CPU or the scorer's."""
        return self.likelihood.log_score(self._counts(poses), self.coverage)

    def score(self, pose: Tensor) -> float:
        """The F-measure, 0 .. 1, of a pose (1, 27)."""
        return float(self.likelihood.score(self._counts(pose)))

    def _counts(self, poses: Tensor) -> Counts:
        if poses.device.type != "cpu":
            return self.scorer(poses, self.evidence)
        there = on_device(poses, self.device)
        return Counts(*on_host(*self.scorer(there, self.evidence)))


@dataclass(frozen=True, eq=False)
class KeypointsTerm:
    """Cost of joints away from the detector's keypoints: the mean of their squared deviations in
    standard deviations, robust (Geman-McClure).
    """

    keypoints: Keypoints
    weight: float

    def __call__(self, poses: Tensor, joints_m: Tensor) -> Tensor:
        """See Term."""
        # In numpy: on a few poses each of torch's operations takes longer than its arithmetic.
        away = joints_m.numpy() - self.keypoints.points_m.numpy()
        off = np.square(away).sum(-1) / np.square(self.keypoints.sigma_m.numpy())
        return torch.from_numpy(-self.weight * (off / (1 + off / _FAR_SIGMAS**2)).mean(1))


@dataclass(frozen=True, eq=False)
class OverlapTerm:
    """Cost of fingers in one another. Else what is no hand, such as an elbow, looks like one with
    overlapping fingers: without this term a fresh draw is usable in 28 instead of 91 %.
    """

    hand_length_m: float
    weight: float

    def __call__(self, poses: Tensor, joints_m: Tensor) -> Tensor:
        """See Term."""
        return -self.weight * finger_overlap(joints_m, self.hand_length_m)


@dataclass(frozen=True, eq=False)
class OtherHandTerm:
    """Cost of joints that lie in another hand.  other_m: (J, 3) its joints."""

    other_m: Tensor
    weight: float

    def __call__(self, poses: Tensor, joints_m: Tensor) -> Tensor:
        """See Term."""
        return -self.weight * touching(joints_m, self.other_m)


@dataclass(frozen=True, eq=False)
class Posterior:
    """The posterior of one hand in one frame.

    joints: from poses (N, 27) to joints (N, 21, 3).  terms: by name, all but the image's.
    """

    image: ImageTerm
    joints: Callable[[Tensor], Tensor]
    terms: Mapping[str, Term] = field(default_factory=dict)

    def __call__(self, poses: Tensor) -> Tensor:
        """(N,) log posteriors of poses (N, 27) on the CPU."""
        return self.value(poses, self.joints(poses))

    def value(self, poses: Tensor, joints: Tensor) -> Tensor:
        """The same of poses whose joints (N, 21, 3) are known."""
        total = self.image(poses)
        for term in self.terms.values():
            total = total + term(poses, joints)
        return total


def touching(joints_m: Tensor, other_m: Tensor) -> Tensor:
    """(N,) how much of hands (N, 21, 3) lies in another one (J, 3), 0 .. 1."""
    near = torch.cdist(joints_m, other_m.to(joints_m)[None].expand(len(joints_m), -1, -1))
    return (1 - near.amin(2) / _TOUCH_M).clamp(min=0).mean(1)
