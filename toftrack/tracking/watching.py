"""The other hand: where one hand is asked for, a second one that is in view is followed as well, so
that it is never taken for the first one; it is not reported.

Slot 0 is the hand that was asked for, slot 1 is watched.
"""

from __future__ import annotations

import math
from dataclasses import replace

from toftrack.estimate import Estimate
from toftrack.tracking.handedness import OTHER_SIDE, HandednessSettings
from toftrack.tracking.state import HandState, LastSeen, Track, TrackerState

_SOUGHT_S = 0.07
"""How often the first hand is searched for while only the other one is followed."""
_GONE_S = 2.0
"""The first hand that has been away so long makes way for the other; not one of a given side."""
_BACK = 0.9
"""A hand that turns out to be of the given side after all is the first one again."""
WATCHED_TRIED_S = 0.16
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
    if first.track is not None and first.handedness.contradicted(first.side, settings):
        return _other_after_all(state, first.track)
    if first.track is None and other.track is not None and _is_first(first, other):
        return _first_after_all(state, other.track)
    return state


def told_apart(estimate: Estimate, state: TrackerState) -> Estimate:
    """The first hand's estimate, where only the other hand is followed."""
    first, other = state.hands
    if first.track is not None or not (other.believed or state.second_s == math.inf):
        return estimate
    return replace(estimate, lost=True, state_name="other hand")


def _other_after_all(state: TrackerState, track: Track) -> TrackerState:
    """The first slot has followed the other hand, which the watched slot goes on with."""
    first, other = state.hands
    side, handedness = OTHER_SIDE[first.side], first.handedness
    known = replace(handedness, given=False, told=0.0, fits=handedness.fits)
    if other.track is None:
        other = replace(other, side=side, handedness=known, seen=LastSeen(track.mean, 0.0))
    first = replace(first, track=None, handedness=replace(handedness, fits=0.0))
    return replace(state, hands=(first, other), second_s=math.inf)


def _is_first(first: HandState, other: HandState) -> bool:
    """Whether the hand that is watched is the one that was asked for."""
    if not first.handedness.given:
        return other.believed and not first.seen.age_s < _GONE_S
    sure = other.handedness.probability(first.side) > _BACK
    return other.side == first.side and sure and not other.beside


def _first_after_all(state: TrackerState, track: Track) -> TrackerState:
    first, other = state.hands
    told = replace(first.handedness, fits=other.handedness.fits)
    handedness = told if told.given else other.handedness
    first = replace(
        first,
        side=other.side,
        handedness=handedness,
        shape=other.shape,
        track=track,
        seen=other.seen,
    )
    return replace(state, hands=(first, replace(other, track=None, beside=False)), second_s=0.0)
