"""Handedness: evidence for a right and for a left hand, summed up over comparisons.

The same image is explained twice, by the detector's poses of a right hand and by those of a left
one, each brought onto the seen points; their posteriors are compared (comparing.py). The network's
own word counts a little beside them: where the image says nothing, as of a fist that does not move,
it is right more often, but it believes a wrong pose whose crop it sees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from toftrack.frames import DepthImage

_BODY_COMPARISONS = 20
"""Comparisons over which the body's place is averaged."""
_FIRST_COMPARISONS = 5
"""Whatever a given side is taken for, a new hand is compared so often before it is sure."""
_OF_EITHER = 0.25
"""So much of the user's word is left where two hands are seen: it does not say which one it is of.
"""
_BEHIND_M = (0.12, 0.55)
"""The body lies so far behind a hand that is raised before it."""
_BODY_M2, _BODY_ROWS = 0.03, 72
"""Its least area that is seen, and rows of the image that it is searched in."""
OTHER_SIDE = {"right": "left", "left": "right"}


@dataclass(frozen=True)
class HandednessSettings:
    """How the side is detected.

    weight, largest: a comparison counts `weight` times the difference of the log posteriors, at
        most `largest`.
    keypoints: weight of the keypoints in a comparison; little, for the network sees a hand of
        either side where it looks for one.
    network: weight of the difference of the network's own log odds of the two sides.
    most: log odds that are never exceeded.  kept: likewise when the hand has left.
    shoulder: log odds for each m that the body is beside the hand: people face the camera.
    shoulder_most: they are never more.
    partner: log odds that two hands which are tracked at once are of different sides.
    sure: probability from which on the sides are compared less often.
    interval_unsure_s, interval_sure_s, interval_given_s: seconds between two comparisons while
        unsure, while sure, and while a given side is sure.
    given: log odds that a given side is that of what is followed, before anything is compared.
    other: probability below which what is followed is not the hand of the given side.
    watch_s: seconds between two searches for another hand than the one that is followed.
    """

    weight: float = 2.0
    largest: float = 3.0
    keypoints: float = 0.1
    network: float = 0.03
    most: float = 6.0
    kept: float = 1.4
    shoulder: float = 10.0
    shoulder_most: float = 1.0
    partner: float = 2.0
    sure: float = 0.95
    interval_unsure_s: float = 0.08
    interval_sure_s: float = 0.4
    given: float = 2.0
    interval_given_s: float = 1.2
    other: float = 0.08
    watch_s: float = 2.0


@dataclass(frozen=True)
class HandednessEstimate:
    """Which hand it is; all but the body's place are log odds of a right hand.

    given: the user gave the side, which is certain; what is followed may be the other hand.
    prior: by the user's word, where it was given.
    fits: by how much better a right hand explains the image than a left one, summed up.
    shoulder: by where the body is.  partner: by which hand the other one is that is tracked.
    body_m: how far the body is to the image's right of the hand, on average.
    comparisons: how many there were.  age_s: how long ago the last one was.
    """

    given: bool = False
    prior: float = 0.0
    fits: float = 0.0
    shoulder: float = 0.0
    partner: float = 0.0
    body_m: float = 0.0
    comparisons: int = 0
    age_s: float = 0.0

    @property
    def log_odds(self) -> float:
        """That it is a right hand, by all this."""
        return self.prior + self.fits + self.shoulder + self.partner

    def probability(self, side: str) -> float:
        """That the hand is of a side; 1 where it was given."""
        return 1.0 if self.given else self.seems(side)

    def comparison_due(self, settings: HandednessSettings, tracked: bool, dt_s: float) -> bool:
        """Whether both sides are to be compared in a frame, dt_s after the last."""
        if not tracked:
            return True
        interval = settings.interval_unsure_s
        new = self.given and self.comparisons < _FIRST_COMPARISONS
        if abs(self.log_odds) > math.log(settings.sure / (1 - settings.sure)) and not new:
            interval = settings.interval_given_s if self.given else settings.interval_sure_s
        return self.age_s + dt_s >= interval

    def seems(self, side: str) -> float:
        """Probability that what is followed is of a side, also where the side was given."""
        log_odds = self.log_odds if side == "right" else -self.log_odds
        return 1 / (1 + math.exp(-log_odds))

    def contradicted(self, side: str, settings: HandednessSettings) -> bool:
        """Whether what is followed is surely the other hand than the one that was given."""
        return self.given and self.seems(side) < settings.other

    def waited(self, dt_s: float) -> HandednessEstimate:
        """After a frame without a comparison."""
        return replace(self, age_s=self.age_s + dt_s)

    def compared(
        self, gain: float, body_m: float, settings: HandednessSettings
    ) -> HandednessEstimate:
        """After one more comparison: how much better a right hand is, and where the body."""
        comparisons = self.comparisons + 1
        fits = self.fits + settings.weight * min(max(gain, -settings.largest), settings.largest)
        fits = min(max(fits, -settings.most), settings.most)
        body_m = self.body_m + (body_m - self.body_m) / min(comparisons, _BODY_COMPARISONS)
        most = settings.shoulder_most
        shoulder = 0.0 if self.given else min(max(settings.shoulder * body_m, -most), most)
        return replace(
            self, fits=fits, shoulder=shoulder, body_m=body_m, comparisons=comparisons, age_s=0.0
        )

    def left(self, settings: HandednessSettings) -> HandednessEstimate:
        """After the hand has left: the next one is likely, but not surely, the same."""
        before = self.fits + self.shoulder
        kept = min(max(before, -settings.kept), settings.kept)
        kept = 0.0 if self.given else kept  # which hand it was says nothing of which one it is
        fresh = HandednessEstimate(self.given, self.prior, partner=self.partner, age_s=self.age_s)
        return replace(fresh, fits=kept)

    def alone(self, settings: HandednessSettings) -> HandednessEstimate:
        """The same where no other hand is tracked."""
        prior = math.copysign(settings.given, self.prior) if self.given else 0.0
        return replace(self, prior=prior, partner=0.0)

    def beside(self, other: HandednessEstimate, settings: HandednessSettings) -> HandednessEstimate:
        """The same where another hand is tracked: a person's two hands are not of one side.

        Where one hand is asked for, the given side is that of either of the two, and what is seen
        of both says of which. Where two are, each has its own, and both may be exchanged.
        """
        if self.given:
            left = 1.0 if other.given else _OF_EITHER
            prior = math.copysign(left * settings.given, self.prior)
            most = settings.partner
            return replace(self, prior=prior, partner=-min(max(other.fits, -most), most))
        surely = math.tanh(0.5 * (other.fits + other.shoulder))
        return replace(self, partner=-settings.partner * surely)


def body_offset_m(image: DepthImage, centre_m: np.ndarray) -> float:
    """How far a body behind a hand is to the image's right of it; 0 where none is seen.

    Who faces the camera has the right hand to the image's left of the body, as a rule.
    """
    step = max(1, int(image.depth_m.shape[0] / _BODY_ROWS))
    depth = image.depth_m[::step, ::step]
    behind = (depth > centre_m[2] + _BEHIND_M[0]) & (depth < centre_m[2] + _BEHIND_M[1])
    columns, z = np.nonzero(behind)[1] * step, depth[behind]
    focal = float(image.k[0, 0])
    if np.square(z * step / focal).sum() < _BODY_M2:
        return 0.0
    return float(np.median((columns - image.k[0, 2]) / focal * z)) - float(centre_m[0])
