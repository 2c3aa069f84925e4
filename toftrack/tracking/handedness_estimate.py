"""How sure it is whose hand is tracked, and the settings of finding out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from toftrack.checks import check_number

_BODY_DETECTIONS = 20
"""Looks over which the body's place is averaged."""
OTHER_SIDE = {"right": "left", "left": "right"}


@dataclass(frozen=True)
class HandednessSettings:
    """How the side is found out; see conf/hand for what each does."""

    weight: float
    largest: float
    most: float
    kept: float
    shoulder: float
    shoulder_most: float
    partner: float
    sure: float
    interval_unsure_s: float
    interval_sure_s: float

    def __post_init__(self) -> None:
        for name in ("weight", "largest", "most", "kept", "shoulder", "shoulder_most", "partner"):
            check_number(f"hand.sides.{name}", getattr(self, name), 0)
        for name in ("interval_unsure_s", "interval_sure_s"):
            check_number(f"hand.sides.{name}", getattr(self, name), 0)
        check_number("hand.sides.sure", self.sure, 0.5, 0.999)


@dataclass(frozen=True)
class HandednessEstimate:
    """Whose hand it is thought to be; all but the body's place are log odds of a right hand.

    fits: by how much better a right hand explains the image than a left one, summed over looks.
    shoulder: by where the body is.  partner: by which hand the other one is that is tracked.
    body_m: how far the body is to the image's right of the hand, on average.
    looks: how many there were.  unlooked_s: how long ago the last one was.
    """

    fits: float = 0.0
    shoulder: float = 0.0
    partner: float = 0.0
    body_m: float = 0.0
    comparisons: int = 0
    undetected_time_s: float = 0.0

    @property
    def log_odds(self) -> float:
        """That it is a right hand, by all this."""
        return self.fits + self.shoulder + self.partner

    def compared(self, gain: float, body_m: float, fit: HandednessSettings) -> HandednessEstimate:
        """After one more look: how much better a right hand is, and where the body."""
        comparisons = self.comparisons + 1
        fits = self.fits + fit.weight * min(max(gain, -fit.largest), fit.largest)
        fits = min(max(fits, -fit.most), fit.most)
        body_m = self.body_m + (body_m - self.body_m) / min(comparisons, _BODY_DETECTIONS)
        shoulder = min(max(fit.shoulder * body_m, -fit.shoulder_most), fit.shoulder_most)
        return HandednessEstimate(fits, shoulder, self.partner, body_m, comparisons)

    def left(self, fit: HandednessSettings) -> HandednessEstimate:
        """After the hand has left: the next one is likely, but not surely, the same."""
        before = self.fits + self.shoulder
        kept = min(max(before, -fit.kept), fit.kept)
        return HandednessEstimate(
            kept, partner=self.partner, undetected_time_s=self.undetected_time_s
        )

    def beside(self, other: HandednessEstimate, fit: HandednessSettings) -> HandednessEstimate:
        """The same where another hand is tracked: a person's two hands are not of one side."""
        surely = math.tanh(0.5 * (other.fits + other.shoulder))
        return replace(self, partner=-fit.partner * surely)


def probability(belief: HandednessEstimate | None, side: str) -> float:
    """That a hand is of a side; 1 where it was told."""
    if belief is None:
        return 1.0
    log_odds = belief.log_odds if side == "right" else -belief.log_odds
    return 1 / (1 + math.exp(-log_odds))


def comparison_due(
    belief: HandednessEstimate | None, fit: HandednessSettings | None, tracked: bool, dt_s: float
) -> bool:
    """Whether both sides are to be compared in a frame, dt_s after the last, if a hand is seen."""
    if fit is None or belief is None:
        return False
    sure = max(probability(belief, side) for side in OTHER_SIDE) > fit.sure
    return not tracked or belief.undetected_time_s + dt_s >= (
        fit.interval_sure_s if sure else fit.interval_unsure_s
    )
