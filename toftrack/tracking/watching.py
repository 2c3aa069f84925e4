"""The other hand: where one hand is asked for, a second one that is in view is followed as well, so
that it is never taken for the first one; it is not reported.

Slot 0 is the hand that was asked for, slot 1 is watched.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from toftrack.estimate import Estimate
from toftrack.gestures.recognition import without_gesture
from toftrack.refinement.shape_fit import first_shape
from toftrack.tracking.handedness import OTHER_SIDE, HandednessSettings
from toftrack.tracking.state import HandState, LastSeen, Track, TrackerState

_SOUGHT_S = 0.07
"""How often the first hand is searched for while only the other one is followed."""
_GONE_S = 2.0
"""The first hand that has been away so long makes way for the other; not one of a given side."""
_BACK = 0.9
"""A hand that turns out to be of the given side after all is the first one again."""
_RATHER, _UNSURE = 0.7, 0.6
"""Likewise with so much, while what is taken for the first one is less probably of that side."""
_COMPARED, _AS_SURE = 3, 1.0
"""It must have been compared so often, though. And what is hardly a hand has no side: the log odds
that its estimate is right must not be lower than the first one's by more than this."""
_MORE = 1.2
"""Or with as much, and when by such log odds more speaks for its side, while what is taken for the
first one was never believed."""
_SURELY = 0.9
"""Of two hands that both look like the given side, the first one must be of it so probably."""
OTHER_HAND = 0.4
"""Where it is less probable than this that what is followed is of the given side, the frame is
flagged."""
WATCHED_TRIED_S = 0.3
"""A watched track ends when it was not believed for so long: things are tried, too."""


def watched_slots(state: TrackerState, watch_s: float) -> list[int]:
    """The slots that a frame is about, in their order.

    While neither hand is followed, the first one is searched for; but what has just turned out to
    be the other hand is found as such first.
    """
    first, other = (hand.track for hand in state.hands)
    if first is None and other is None:
        return [1, 0] if state.second_s == math.inf else [0]
    if first is None:
        return [1, 0] if state.second_s >= _SOUGHT_S else [1]
    if other is None:
        if state.second_s == math.inf:
            return [1, 0]
        return [0, 1] if state.second_s >= watch_s else [0]
    return [0, 1] if not first.doubted or other.doubted else [1, 0]


def watched_over(state: TrackerState, settings: HandednessSettings) -> TrackerState:
    """After a frame: which of the hands is the one that was asked for."""
    first, other = state.hands
    if other.track is None:
        other = replace(other, beside=False)
    elif first.believed and other.believed:
        other = replace(other, beside=True)
    state = replace(state, hands=(first, other))
    if other.track is not None and _is_first(first, other):
        return _first_after_all(state, other.track)
    if first.track is not None and first.handedness.contradicted(first.side, settings):
        return _other_after_all(state, first.track)
    return state


def first_estimate(estimate: Estimate, state: TrackerState) -> Estimate:
    """The first hand's estimate: lost where only the other hand is followed, or where either of two
    may be the one that was asked for.
    """
    first, other = state.hands
    away = first.track is None and (other.believed or state.second_s == math.inf)
    if not (away or _either(first, other)):
        return estimate
    none = np.zeros_like(estimate.joint_ok)
    lost = replace(estimate, lost=True, state_name="other hand", joint_ok=none)
    return without_gesture(lost)


def _either(first: HandState, other: HandState) -> bool:
    """Whether both hands look like the given side, and the first one not surely."""
    if not (first.handedness.given and first.believed and other.believed):
        return False
    alike = other.side == first.side and first.handedness.seems(first.side) < _SURELY
    return alike and _as_sure(first, other)


def _as_sure(first: HandState, other: HandState) -> bool:
    """Whether what is watched is about as surely a hand as what is taken for the first one."""
    assert first.track is not None and other.track is not None
    return other.track.log_odds > first.track.log_odds - _AS_SURE


def _other_after_all(state: TrackerState, track: Track) -> TrackerState:
    """The first slot has followed the other hand, which the watched slot is to go on with."""
    first, other = state.hands
    if other.track is None:
        other = _passed_on(first, other, track)
    first = replace(first, track=None, handedness=replace(first.handedness, fits=0.0))
    return replace(state, hands=(first, other), second_s=math.inf)


def _passed_on(first: HandState, other: HandState, track: Track) -> HandState:
    """The watched slot before it finds the other hand where the first slot's track is."""
    return replace(
        other,
        side=OTHER_SIDE[first.side],
        handedness=replace(first.handedness, given=False, prior=0.0),
        shape=first_shape(),
        seen=LastSeen(track.mean, 0.0, surest=track.surest if track.believed else -math.inf),
        track=None,
        beside=False,
    )


def _is_first(first: HandState, other: HandState) -> bool:
    """Whether the hand that is watched is the one that was asked for."""
    probable = other.handedness.probability(first.side)
    if not first.handedness.given:
        if first.track is not None or not other.believed:
            return False
        # Of the same side, and never seen beside it: the first hand has come back.
        alike = not other.beside and other.side == first.side and probable > _RATHER
        return alike or not first.seen.age_s < _GONE_S
    if other.side != first.side:
        return False
    if first.track is None:
        return probable > _BACK and not other.beside
    if not _as_sure(first, other):
        return False
    if first.believed or other.beside:
        compared = other.handedness.comparisons >= _COMPARED
        return compared and probable > _RATHER and first.handedness.seems(first.side) < _UNSURE
    more = other.handedness.fits - first.handedness.fits
    return probable > _RATHER and (more if first.side == "right" else -more) > _MORE


def _first_after_all(state: TrackerState, track: Track) -> TrackerState:
    """The watched slot has followed the hand that was asked for; perhaps the first one another."""
    first, other = state.hands
    left, second_s = replace(other, track=None, beside=False), 0.0
    if first.track is not None:
        left, second_s = _passed_on(first, other, first.track), math.inf
    fits, given = other.handedness.fits, first.handedness.given
    handedness = replace(first.handedness, fits=fits) if given else other.handedness
    first = replace(first, handedness=handedness, side=other.side, shape=other.shape, track=track)
    return replace(state, hands=(replace(first, seen=other.seen), left), second_s=second_s)
