"""Fitting the hand's size to the user over the first second of tracking, without networks.

With networks the whole shape is fitted, and more exactly: see shape_fit.py.

Depth is metric, so an image tells the size of a hand whose pose is known. Each believed estimate is
tried again at a few sizes, with the pose free to follow a little, and the best scores at each size,
summed over frames, make a profile likelihood of the size.

Bones and thickness are not fitted by themselves. Two ways were tried on five recordings, one seed.
Normal equations of the seen points over frames with the poses marginalised (Tkach et al., "Online
generative model personalization for hand tracking", SIGGRAPH Asia 2017) found 1 of the 15 % by
which an index finger had been shortened. Profile likelihoods of each finger's length, the palm's
and the thickness found 4 % of it and thickened every hand; the mean error rose from 6.5 to 6.8 mm,
and without the shortening from about 5.3 to 6.0 mm.

A hand of size s at depth Z looks the same as a hand of size 1 at depth Z / s, so no other hand is
built: the evidence is taken closer instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from toftrack.checks import check_number
from toftrack.compute.backend import Motions
from toftrack.compute.rigid import rotated_pivot
from toftrack.hand import make_hand_shape
from toftrack.hand.shape import Fitted, HandShape
from toftrack.hand.shape_space import COMPONENTS
from toftrack.render.scoring import Evidence
from toftrack.tracking.shape_fit import ShapeFit
from toftrack.tracking.side_belief import SideFit

_REACH = 3  # sizes tried on either side of the present one
_TRIED = (1.0, 1.12, 0.9, 1.24, 0.8)  # sizes of starts, in turn


@dataclass(frozen=True)
class HandFit:
    """How the size is fitted.

    frames: believed estimates that are used; then the size stays.
    prior: standard deviation of the logarithm of hands' lengths about the first one.
    step: ratio of neighbouring sizes, less 1.  largest: the largest ratio to the first size.
    samples: poses tried at each size.
    exponent: a frame's likelihood is its score to this power.
    beta: of the F-measure that sizes are compared by, in place of the likelihood's: where missed
        pixels count more than false ones, too large a hand fits best (by 2 to 4 % at 1.5).
    """

    frames: int
    prior: float
    step: float
    largest: float
    samples: int
    exponent: float
    beta: float

    def __post_init__(self) -> None:
        for name, least in (("frames", 0), ("samples", 1)):
            check_number(f"hand.fit.{name}", getattr(self, name), least, whole=True)
        for name in ("prior", "step", "exponent", "beta"):
            check_number(f"hand.fit.{name}", getattr(self, name), 0, above=True)
        check_number("hand.fit.largest", self.largest, 1)


@dataclass(frozen=True)
class Hand:
    """The hand of a configuration: a shape, and how it is fitted to the user (None: it is not).

    fit: of the size, where there are no networks.  adapt: of the shape, where there are.
    sides: of the side; None where it is told.
    """

    shape: HandShape
    fit: HandFit | None
    adapt: ShapeFit | None
    sides: SideFit | None


def make_hand(
    shape: str, side: str, length_m: float, fit: HandFit, adapt: ShapeFit, sides: SideFit
) -> Hand:
    """See toftrack.hand.make_hand_shape; only shape="auto" is fitted, and only side="auto" found
    out: it begins as a right hand.
    """
    made = make_hand_shape(shape, "right" if side == "auto" else side, length_m)
    found = sides if side == "auto" else None
    return Hand(made, fit, adapt, found) if shape == "auto" else Hand(made, None, None, found)


@dataclass(frozen=True)
class SizeBelief:
    """Log likelihood of each size so far.

    log_likelihood: (S,) on the CPU, over sizes (1 + step) ** (index - S // 2) of the first hand.
    index: of the present size.  frames: how many estimates went in.
    """

    log_likelihood: Tensor
    index: int
    frames: int = 0

    def ratio(self, fit: HandFit) -> float:
        """The present size in units of the first hand's."""
        return (1 + fit.step) ** (self.index - len(self.log_likelihood) // 2)

    def summary(self, fit: HandFit) -> Fitted:
        """For the file of the shape, whose one component is the length."""
        half = len(self.log_likelihood) // 2
        log_size = torch.arange(-half, half + 1) * math.log1p(fit.step)
        probability = self.log_likelihood.softmax(0)
        mean = float(probability @ log_size)
        variance = float(probability @ (log_size - mean).square())
        done = self.frames >= fit.frames
        return Fitted(COMPONENTS[:1], (mean,), ((variance,),), self.frames, done)


def first_belief(fit: HandFit) -> SizeBelief:
    """Before any frame was seen: the prior."""
    half = int(math.log(fit.largest) / math.log1p(fit.step))
    log_size = torch.arange(-half, half + 1) * math.log1p(fit.step)
    return SizeBelief(-0.5 * (log_size / fit.prior).square(), half)


def retried(fit: HandFit, attempt: int) -> SizeBelief:
    """The belief to start with after `attempt` starts that were not believed: another size.

    A hand of the wrong size fits so badly that no start is believed, and then nothing is fitted.
    """
    belief = first_belief(fit)
    ratio = _TRIED[attempt % len(_TRIED)]
    index = belief.index + round(math.log(ratio) / math.log1p(fit.step))
    return replace(belief, index=min(max(index, 0), len(belief.log_likelihood) - 1))


def update(
    belief: SizeBelief,
    fit: HandFit,
    state: Tensor,
    evidence: Evidence,
    log_scores: Callable[[Tensor, Evidence], Tensor],
    motions: Motions,
    generator: torch.Generator,
) -> SizeBelief:
    """What is believed after one more estimate.

    state: (1, 27) refined with a hand of the present size.
    log_scores: of (N, 27) such hands, (N,), by an F-measure of fit.beta.
    """
    sizes = len(belief.log_likelihood)
    around = range(max(0, belief.index - _REACH), min(sizes, belief.index + _REACH + 1))
    noise = torch.randn(fit.samples, 27, generator=generator, device=state.device)
    noise = noise * noise.new_tensor([0.004] * 3 + [0.03] * 3 + [0.06] * 21)
    noise[0] = 0.0
    moved = motions.compose(state, noise)  # every angle is a coordinate here
    scores = []
    for index in around:
        ratio = (1 + fit.step) ** (index - belief.index)
        closer = replace(
            evidence,
            low=evidence.low * ratio,
            high=evidence.high * ratio,
            occluder=evidence.occluder * ratio,
        )
        # The middle of the hand stays where it is: about the wrist, it would grow out of place.
        middle = moved[:, :3] + rotated_pivot(moved[:, 3:6])
        states = torch.cat(((middle - ratio * (middle - moved[:, :3])) / ratio, moved[:, 3:]), 1)
        best = log_scores(states, closer).max()
        scores.append(fit.exponent * float(best))
    total = belief.log_likelihood.clone()
    # Sizes that were not tried are as unlikely as the nearest one that was.
    total[: around[0]] += scores[0]
    total[around[-1] + 1 :] += scores[-1]
    total[around[0] : around[-1] + 1] += torch.tensor(scores)
    return SizeBelief(total, int(total.argmax()), belief.frames + 1)
