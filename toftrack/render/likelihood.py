"""The head that scores hypotheses against an observation (paper, section 2.3, "Observation")."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.compiling import entry_point
from toftrack.errors import ToftrackError, check_choice, check_number
from toftrack.hand.shape import HandShape
from toftrack.render.scoring import Counts, Evidence, Scorer
from toftrack.render.segmentation import Observation

_LEAST_M = np.float32(1e-3)
NAMINGS = ("printed", "standard")


@dataclass(frozen=True)
class Likelihood:
    """What every head has; one of one's own writes `score`.

    tolerance_m: a model pixel this near to the image's depth is correct (the paper: 0.02).
    neighbourhood_m: how far from the silhouette, at the hand's depth, pixels are missed ("in
        proportion to the finger's length": about a third of a finger).
    """

    tolerance_m: float
    neighbourhood_m: float

    def __post_init__(self) -> None:
        check_number("likelihood.tolerance_m", self.tolerance_m, 0, above=True)
        check_number("likelihood.neighbourhood_m", self.neighbourhood_m, 0)

    def evidence(self, observation: Observation) -> Evidence:
        """The images to compare with, once a frame."""
        seen = observation
        given = [seen.hand.numpy(), seen.occluder.numpy()]
        for mask in (seen.other, seen.thing):
            given.append(np.zeros_like(given[0]) if mask is None else mask.numpy())
        images = np.empty((3, *seen.depth_m.shape), np.float32)
        _band(seen.depth_m.numpy(), *given, np.float32(self.tolerance_m), images)
        lowest, highest, hidden = torch.from_numpy(images)
        distance_m = 1.0 if observation.empty else observation.nearest_m
        radius = self.neighbourhood_m * float(observation.k[0, 0]) / distance_m
        return Evidence(lowest, highest, hidden, observation.hand, observation.k, radius)

    def score(self, counts: Counts) -> Tensor:
        """(N,) or (B, N), as the counts are: of hypotheses, 0 .. 1; 0 where nothing is correct."""
        raise NotImplementedError

    def log_score(self, counts: Counts, coverage: float | None = None) -> Tensor:
        """As score, what the filter weighs by, up to a constant: log score + coverage log(correct).

        coverage: instead of the likelihood's own, for a search that compares very different poses.
        """
        score = self.score(counts).log()
        # 0 times the logarithm of no correct pixel would be NaN, and the largest of all.
        return score + coverage * counts.correct.log() if coverage else score

    def scorer(self, shape: HandShape, given: Scorer) -> Scorer:
        """What makes the counts of a hand; that of the back end unless a head wants more of it."""
        return given


@entry_point
def _band(depth, hand, occluder, other, thing, tolerance, images):
    """low, high and occluder of an Evidence, into images (3, H, W).

    A model surface at an occluder is hidden, not false; at another hand only behind it. Without
    branches, so that pixels are computed side by side.
    """
    inverse, nothing, never = np.float32(1), np.float32(0), np.float32(np.inf)
    lowest, highest, hidden = images[0], images[1], images[2]
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z, seen = depth[v, u], hand[v, u]
            low, high = inverse / (z + tolerance), inverse / max(z - tolerance, _LEAST_M)
            lowest[v, u], highest[v, u] = low if seen else never, high if seen else -never
            behind = inverse / z if other[v, u] & (z > 0) else nothing
            hidden[v, u] = never if occluder[v, u] | thing[v, u] else behind


@dataclass(frozen=True)
class FMeasure(Likelihood):
    """The paper's F-measure of correct, false and missed pixels.

    beta: weight of the second of the two rates (paper: 1.5).
    naming: the paper prints precision = c / (c + missed) and recall = c / (c + false), so that
        beta > 1 punishes *false* pixels more, while its text wants more penalty for missed ones.
        "printed" is the paper's formula, "standard" the usual names.
    residual_weight: how much of a correct pixel is lost at the edge of the depth tolerance,
        0 (paper, all or nothing) .. 1 (a parabola that falls to 0).
    coverage: how much hypotheses are preferred that explain more of the image: the F-measure is
        content with a hand of which only a few pixels lie inside of it.
    """

    beta: float
    naming: str
    residual_weight: float
    coverage: float

    def __post_init__(self) -> None:
        check_choice("likelihood.naming", self.naming, NAMINGS)
        super().__post_init__()
        check_number("likelihood.beta", self.beta, 0, above=True)
        check_number("likelihood.residual_weight", self.residual_weight, 0, 1)
        check_number("likelihood.coverage", self.coverage, 0)

    def log_score(self, counts: Counts, coverage: float | None = None) -> Tensor:
        """See Likelihood."""
        coverage = self.coverage if coverage is None else coverage
        if counts.correct.device.type == "cpu":
            return self._on_host(counts, coverage, logarithm=True)
        return super().log_score(counts, coverage)

    def score(self, counts: Counts) -> Tensor:
        """The F-measure, see Likelihood.score."""
        if counts.correct.device.type == "cpu":
            return self._on_host(counts, 0.0, logarithm=False)
        correct, false, missed, residual = counts
        taken, (of_false, of_missed) = self.residual_weight * residual, self._weights
        # What the residual takes from correct, it gives to false: F only falls.
        correct, false = correct - taken, false + taken
        weighted = (1 + self.beta**2) * correct
        rest = of_false * false + of_missed * missed
        return weighted / (weighted + rest).clip(min=1e-9)

    @property
    def _weights(self) -> tuple[float, float]:
        """Of false and of missed pixels."""
        return (self.beta**2, 1.0) if self.naming == "printed" else (1.0, self.beta**2)

    def _on_host(self, counts: Counts, coverage: float, logarithm: bool) -> Tensor:
        """The same in compiled code: on the CPU each operation takes longer than its arithmetic."""
        given = [np.ascontiguousarray(count.numpy(), np.float32).ravel() for count in counts]
        found = np.empty(counts.correct.shape, np.float32)
        numbers = 1 + self.beta**2, *self._weights, self.residual_weight, coverage
        _f_measures(*given, tuple(map(np.float32, numbers)), logarithm, found.reshape(-1))
        return torch.from_numpy(found)


@entry_point
def _f_measures(correct, false, missed, residual, numbers, logarithm, found):
    """See FMeasure.score and log_score; all (N,) float32.

    numbers: 1 + beta^2, weights of false and of missed pixels, residual_weight, coverage.
    """
    more, of_false, of_missed, weight, coverage = numbers
    for i in range(len(found)):
        taken = weight * residual[i]
        weighted = more * (correct[i] - taken)
        rest = of_false * (false[i] + taken) + of_missed * missed[i]
        found[i] = weighted / max(weighted + rest, np.float32(1e-9))
        if logarithm:
            found[i] = math.log(found[i])
            if coverage > 0:
                found[i] += coverage * math.log(correct[i])


def checked_score(likelihood: Likelihood, counts: Counts) -> Tensor:
    """(N,) its scores; ToftrackError where they are none as `Likelihood.score` has them."""
    found, correct = likelihood.score(counts), counts.correct
    if not isinstance(found, Tensor):
        raise ToftrackError(
            f"likelihood: {type(likelihood).__name__}.score gives {type(found).__name__}; it must "
            "give a tensor, (N,) numbers of 0 to 1"
        )
    pairs = zip(found.reshape(-1).tolist(), correct.tolist(), strict=False)
    if found.shape == correct.shape and all(0 <= one <= 1.0001 * (n > 0) for one, n in pairs):
        return found
    raise ToftrackError(
        f"likelihood: {type(likelihood).__name__}.score gives {found.tolist()} where correct is"
        f" {counts.correct.tolist()}; it must give (N,) numbers of 0 to 1, and 0 where that is 0"
    )
