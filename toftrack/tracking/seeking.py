"""Which hands a frame is about, and the search for a second one, which is spread over frames.

Beside a hand that is followed and believed nothing waits for a search of the whole image: in one
frame the finder looks for places, in the next ones the pose network at these, each beside the
filter of the other hand; only then the slot takes part in a frame, if there is anything.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from toftrack.detector.hand_detector import NO_DETECTION, Detection, merit
from toftrack.detector.proposals import SAME_PLACE_M, Places
from toftrack.frames import DepthImage
from toftrack.render.segmentation import reduce_image
from toftrack.tracking.detect import held_out, reachable, search_due
from toftrack.tracking.filter import predicted_palm
from toftrack.tracking.hands import ONE_HAND_M, Neighbour, OtherHand, placed, sureness, without
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.state import HandState, LastSeen, Seeking, Track, TrackerState
from toftrack.tracking.watching import watched_slots

_SECOND_S = 0.12
"""How often a second hand is searched for."""
_AT_ONCE = 2
"""Places that are looked at in a frame."""
_NEARLY = 3.0
"""The first look may be so much worse than what a hand needs: the second one is more exact."""
_TOUCHING_M = 0.08
"""Palms whose middles are nearer may belong to hands that touch."""
Sought = Callable[[], Seeking]


def taking_part(state: TrackerState, watch_s: float) -> list[int]:
    """The slots that a frame is about, the surest first; one without a hand now and then.

    watch_s: see HandednessSettings.
    """
    slots, sought = due_slots(state, watch_s), searched_beside(state)
    if sought is None or state.hands[sought].track is not None:
        return slots
    slots = [slot for slot in slots if slot != sought]
    return [*slots, sought] if search_is_over(state.hands[sought]) else slots


def due_slots(state: TrackerState, watch_s: float) -> list[int]:
    """The same if a search took one frame."""
    if state.watched:
        return watched_slots(state, watch_s)
    vacant = [hand.track is None for hand in state.hands]
    sought = all(vacant) or state.second_s >= _SECOND_S
    slots = [slot for slot in range(len(vacant)) if sought or not vacant[slot]]
    return sorted(slots, key=lambda slot: -sureness(state.hands[slot]))


def since_search(before: TrackerState, slots: Sequence[int]) -> float:
    """Seconds since a slot without a hand was searched for, after a frame about these slots."""
    sought = len(slots) == 2 and any(hand.track is None for hand in before.hands)
    return 0.0 if sought else before.second_s


def searched_beside(state: TrackerState) -> int | None:
    """The slot whose hand is searched for beside the other one, as it is not there or doubted; None
    where nothing else is followed, or it is known where to look.
    """
    tracks = [hand.track for hand in state.hands]
    sure = [track is not None and track.believed and not track.doubted for track in tracks]
    if len(sure) < 2 or sum(sure) != 1 or state.second_s == math.inf:
        return None
    return sure.index(False)


def search_is_over(hand: HandState) -> bool:
    """Whether all places have been looked at, and something was found."""
    return hand.seeking is not None and hand.seeking.over


def start_seeking(
    state: TrackerState, image: DepthImage, model: TrackerModel, dt_s: float
) -> tuple[TrackerState, Sought | None]:
    """A frame's part of a search beside the other hand, begun where there is any.

    Returns the state, where a search that began is noted, and what waits for that part.
    """
    slot, watch_s = searched_beside(state), model.configured.handedness.watch_s
    if slot is None:
        hands = [replace(hand, seeking=None) if hand.seeking else hand for hand in state.hands]
        return replace(state, hands=tuple(hands)), None
    hand, detector = state.hands[slot], model.detector
    other = state.hands[1 - slot]
    assert other.track is not None
    fitted = model.hand(other.side, other.shape)
    palm = predicted_palm(other.track, dt_s, fitted, model)[0][0]
    likely = partial(reachable, hand, [palm])
    if hand.seeking is not None:
        if search_is_over(hand):
            return state, None
        if hand.seeking.alone:
            image = _alone(other, image, model, dt_s)
        if hand.seeking.anew:
            wait = detector.start_search(image.depth_m, image.k)
            likely = partial(likely, apart_m=ONE_HAND_M)
            return state, partial(_found, wait, likely, alone=True)
        at = hand.seeking.centres_m[:_AT_ONCE]
        pending = [detector.start(image.depth_m, image.k, one, hand.side) for one in at]
        return state, partial(_after_detecting, hand.seeking, pending)
    due = hand.track is not None or slot in due_slots(state, watch_s)
    if not due or not search_due(hand, model):
        return state, None
    wait = detector.start_search(image.depth_m, image.k)
    hands = list(state.hands)
    hands[slot] = replace(hand, searched_s=0.0)
    second_s = 0.0 if hand.track is None else state.second_s
    return replace(state, hands=tuple(hands), second_s=second_s), partial(_found, wait, likely)


def _touches(hand: HandState, other: Track) -> bool:
    """Whether a hand was last seen where it touches the one that is surely followed: of such hands
    the finder may see one place, between them.
    """
    beside = LastSeen(other.mean, 0.0).centre_m
    return hand.seen.ever and float(np.linalg.norm(hand.seen.centre_m - beside)) < _TOUCHING_M


def _alone(other: HandState, image: DepthImage, model: TrackerModel, dt_s: float) -> DepthImage:
    """The image without the pixels that the other hand, which is surely followed, explains."""
    assert other.track is not None
    depth_m, k = reduce_image(image.depth_m, image.k, model.segmentation.max_pixels)
    size = (depth_m.shape[0], depth_m.shape[1])
    theirs = placed(other, other.track, model, k, size, dt_s)
    seen = Neighbour(theirs, None, True, True, other.watched).seen(depth_m)
    return without(image, [seen], wholly=True)


def _found(
    wait: Callable[[], Places], likely: Callable[..., float], alone: bool = False
) -> Seeking:
    """A search after the finder's part; places where the hand cannot be are none."""
    places = wait()
    possible = [row for row, at in enumerate(places.centre_m) if likely(at) > -math.inf]
    return Seeking(places.centre_m[possible], places.probability[possible], alone=alone)


def _after_detecting(seeking: Seeking, pending: Sequence[Callable[[], Detection]]) -> Seeking:
    """A search after the pose network was asked about some places more."""
    seen = [(wait(), float(heat)) for wait, heat in zip(pending, seeking.heat, strict=False)]
    rest = slice(len(pending), None)
    return replace(
        seeking,
        centres_m=seeking.centres_m[rest],
        heat=seeking.heat[rest],
        seen=(*seeking.seen, *seen),
    )


def sought(state: TrackerState, wait: Sought | None, model: TrackerModel) -> TrackerState:
    """The state with what a frame's part of a search has found."""
    if wait is None:
        return state
    slot = searched_beside(state)
    assert slot is not None
    hand, other, seeking = state.hands[slot], state.hands[1 - slot].track, wait()
    assert other is not None
    nowhere = seeking.over and not seeking.seen and not seeking.alone
    if nowhere and not state.watched and _touches(hand, other):
        so_far: Seeking | None = Seeking.anew_alone()
    else:
        so_far = _best(hand, seeking, model) if seeking.over else seeking
    hands = list(state.hands)
    hands[slot] = replace(hand, seeking=so_far)
    return replace(state, hands=tuple(hands))


def _best(hand: HandState, seeking: Seeking, model: TrackerModel) -> Seeking | None:
    """A search that is over with the hand that is meant alone; None where there is none."""
    least = model.detector.settings.merit - _NEARLY
    # Where its track is nothing new is found.
    known = [] if hand.track is None else [LastSeen(hand.track.mean, 0.0).centre_m]
    likely = partial(reachable, hand, known)
    merits = [merit(seen, heat) + likely(seen.centre_m.numpy()) for seen, heat in seeking.seen]
    rows = sorted(range(len(merits)), key=lambda row: -merits[row])
    found = [seeking.seen[row] for row in rows if merits[row] > least]
    if not hand.handedness.given and not hand.seen.ever:
        meant = held_out([seen for seen, _ in found])
        found = [one for one in found if any(one[0] is seen for seen in meant)]
    return replace(seeking, seen=tuple(found[:1])) if found else None


def detect_again(
    hand: HandState,
    seeking: Seeking,
    image: DepthImage,
    others: Sequence[OtherHand],
    model: TrackerModel,
) -> Detection:
    """What is there now where a search has found a hand; NO_DETECTION where it is none after all.

    About the palm that was found, with its fingers upright, poses are more exact.
    """
    detector, (seen, heat) = model.detector, seeking.seen[0]
    apart_m = SAME_PLACE_M
    if seeking.alone:
        image = without(image, others, wholly=True)
        apart_m = ONE_HAND_M
    centre, up = seen.centre_m.numpy()[None], seen.up[None]
    found = detector.detect(image.depth_m, image.k, centre, hand.side, up)[0]
    known = [other.centre_m for other in others]
    likely = reachable(hand, known, found.centre_m.numpy(), apart_m)
    better = merit(found, heat) + likely > detector.settings.merit
    return found if better else NO_DETECTION
