"""The posterior of a hand's pose: one definition for all who compare poses.

    log p(pose | frame) = image + keypoints + overlap + other hand  (up to a constant)

A start, the candidates of a frame, exchanged fingers and the two sides of a hand are compared by
it; the particle filter weighs its particles by the image alone, sharpened. Each term is a small
object, and a term of weight 0 is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields

import torch
from torch import Tensor

from toftrack.checks import check_number
from toftrack.compute.transfer import on_device, on_host
from toftrack.refinement.gauss_newton import Keypoints
from toftrack.render.likelihood import FMeasure
from toftrack.render.scoring import Counts, Evidence, Scorer

_TOUCH_M = 0.018
"""Joints of two hands come no nearer to each other, as a rule: fingers are so thick."""
Term = Callable[[Tensor, Tensor], Tensor]
"""Poses (N, 27) and their joints (N, 21, 3) to log values (N,); everything on the CPU."""


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

    evidence: on the scorer's device.  coverage: see FMeasure.log_score; None = the likelihood's.
    """

    likelihood: FMeasure
    scorer: Scorer
    evidence: Evidence
    device: torch.device
    coverage: float | None = None

    def __call__(self, poses: Tensor, joints_m: Tensor | None = None) -> Tensor:
        """(N, 27) hands, on the CPU or the scorer's device, to (N,) there; joints are not used."""
        return self.likelihood.log_score(self._counts(poses), self.coverage)

    def score(self, pose: Tensor) -> float:
        """(1, 27) to the F-measure, 0 .. 1."""
        return float(self.likelihood.score(self._counts(pose)))

    def _counts(self, poses: Tensor) -> Counts:
        if poses.device.type != "cpu":
            return self.scorer(poses, self.evidence)
        there = on_device(poses, self.device)
        return Counts(*on_host(*self.scorer(there, self.evidence)))


@dataclass(frozen=True, eq=False)
class JointsTerm:
    """Joints away from the detector's keypoints (Geman-McClure), and fingers in one another.

    penalty: of the back end, see refinement/penalty.py.
    """

    penalty: Callable[[Tensor, float, float, Keypoints | None, float], Tensor]
    hand_length_m: float
    keypoints: Keypoints
    keypoints_weight: float
    overlap_weight: float

    def __call__(self, poses: Tensor, joints_m: Tensor) -> Tensor:
        """See Term."""
        return -self.penalty(
            joints_m,
            self.hand_length_m,
            self.overlap_weight,
            self.keypoints,
            self.keypoints_weight,
        )


@dataclass(frozen=True, eq=False)
class OtherHandTerm:
    """Joints that lie in another hand.  other_m: (J, 3) its joints."""

    other_m: Tensor
    weight: float

    def __call__(self, poses: Tensor, joints_m: Tensor) -> Tensor:
        """See Term."""
        return -self.weight * touching(joints_m, self.other_m)


@dataclass(frozen=True, eq=False)
class Posterior:
    """The terms of one hand in one frame.

    joints: hands (N, 27) to joints (N, 21, 3).
    """

    image: ImageTerm
    joints: Callable[[Tensor], Tensor]
    terms: Mapping[str, Term] = field(default_factory=dict)

    def __call__(self, poses: Tensor) -> Tensor:
        """(N, 27) on the CPU to (N,)."""
        return self.image(poses) + self._rest(poses)

    def screened(self, poses: Tensor, most: int) -> Tensor:
        """The same of many poses, of which only the `most` best by the image can be the best.

        The rest are -inf. What the other terms add is small beside what the image tells apart.
        """
        values = self.image(poses)
        if len(poses) <= most:
            return values + self._rest(poses)
        rows = values.topk(most).indices
        total = torch.full_like(values, -torch.inf)
        total[rows] = values[rows] + self._rest(poses[rows])
        return total

    def named(self, poses: Tensor) -> dict[str, Tensor]:
        """Every term by itself, (N,) each."""
        joints = self.joints(poses)
        return {"image": self.image(poses)} | {
            name: term(poses, joints) for name, term in self.terms.items()
        }

    def _rest(self, poses: Tensor) -> Tensor:
        joints, total = self.joints(poses), torch.zeros(len(poses))
        for term in self.terms.values():
            total = total + term(poses, joints)
        return total


def touching(joints_m: Tensor, other_m: Tensor) -> Tensor:
    """(N,) how much of hands (N, 21, 3) lies in another one (J, 3), 0 .. 1."""
    near = torch.cdist(joints_m, other_m.to(joints_m)[None].expand(len(joints_m), -1, -1))
    return (1 - near.amin(2) / _TOUCH_M).clamp(min=0).mean(1)
