"""The detections of a frame: at the predicted hands, and where else hands may be."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from toftrack.compute.pace import Duration
from toftrack.detector.detection import Detection
from toftrack.detector.proposals import SAME_PLACE_M, Places
from toftrack.tracking.association import SideDetection
from toftrack.tracking.confidence import log_odds
from toftrack.tracking.scene import Arm, Scene
from toftrack.tracking.sides import comparison_due
from toftrack.tracking.state import NO_PLACES, OTHER_SIDE, TrackerState

_RARE_S = 0.1
"""Frames farther apart than this are rare: predictions are inexact, so the finder looks first."""
_ARM_M, _ARM_RADIUS_M = 0.3, 0.06
"""Length and radius of a forearm with its sleeve, at most."""
_FOLLOWED = 2
"""By this factor the finder, which takes a fifth of a frame's time, is asked more rarely while
every track is reliable."""
_UNSHOWN = 3
"""Frames from one look at a sure hand that no slot shows to the next: such a hand is followed only
to tell it from the hands that are shown."""
_AS_WELL, _WELL_M = 1.3, 0.02
"""A hand is seen about as well as the best one when its expected error is less than so many times
the best one's, or less than the latter."""


@dataclass(frozen=True, eq=False)
class PendingDetections:
    """The networks at work on a frame.

    at_tracks: each waits for the detection at a predicted hand.
    places, later_places: wait for the finder's places, which are looked at in this frame, to find a
        hand anew, or in the next one; None = the finder is not asked for such.
    """

    at_tracks: Sequence[Callable[[], SideDetection]]
    places: Callable[[], Places] | None = None
    later_places: Callable[[], Places] | None = None

    @property
    def finder_asked(self) -> bool:
        """Whether the finder looks at this frame."""
        return bool(self.places or self.later_places)

    def for_next_frame(self) -> Places:
        """The places that are left to look at in the next frame."""
        return self.later_places() if self.later_places else NO_PLACES


def start_detection(scene: Scene, state: TrackerState) -> PendingDetections:
    """The networks that are due in a frame, which work beside whatever comes next."""
    detector = scene.model.detector
    several = len(state.slots) > 2 and scene.dt_s <= _RARE_S
    image = scene.unexplained if several else scene.image
    followed = bool(scene.hands) and all(hand.track.reliable for hand in scene.hands)
    urgent = not followed or scene.dt_s > _RARE_S
    frames = detector.settings.search * (1 if urgent else _FOLLOWED)
    due = frames == 1 or Duration(state.searched_s).reached(frames)
    search = image.depth_m, image.k, len(scene.hands)
    # What is waited for first is begun first.
    places = detector.start_search(*search) if due and urgent else None
    rows = range(len(scene.hands))
    at_tracks = [_start(scene, row) for row in rows if _is_asked(scene, row, state)]
    later_places = detector.start_search(*search) if due and not urgent else None
    return PendingDetections(at_tracks, places, later_places)


def finish_detection(
    pending: PendingDetections, scene: Scene, state: TrackerState
) -> list[SideDetection]:
    """All detections of a frame, those at tracks first."""
    places = pending.places() if pending.places else state.places
    seen = [wait() for wait in pending.at_tracks]
    rare = scene.dt_s > _RARE_S
    believed = [] if rare else [hand.palm_m for hand in scene.hands if hand.track.reliable]
    places = _apart_from(believed, places)
    found = _elsewhere(scene, state, places, rare) if len(places.centre_m) else []
    arms = _arms(scene, seen) if found and not rare else []
    return seen + [
        one
        for one in found
        if not any(one.detection.merit <= most and _is_on(arm, one.detection) for arm, most in arms)
    ]


def rests(scene: Scene, row: int, state: TrackerState) -> bool:
    """Whether a track is only moved on in this frame: a sure one that no slot shows and that the
    pose network looked at lately.
    """
    track = scene.hands[row].track
    waited = Duration(track.asked_s).reached(_UNSHOWN)
    return not state.shows(track) and not waited and _is_sure(scene, row)


def _is_sure(scene: Scene, row: int) -> bool:
    track, least = scene.hands[row].track, scene.model.detector.settings.sure
    return track.reliable and track.log_odds > log_odds(least)


def _is_asked(scene: Scene, row: int, state: TrackerState) -> bool:
    """Whether the pose network looks at a track in this frame; at sure ones it looks rarely."""
    if rests(scene, row, state):
        return False
    track, every = scene.hands[row].track, scene.model.detector.settings.every
    waited = every == 1 or Duration(track.asked_s).reached(every)
    return not _is_sure(scene, row) or waited or comparison_due(track)


def _start(scene: Scene, row: int) -> Callable[[], SideDetection]:
    """A function that waits for the detection at a predicted hand, where a comparison is due also
    for the detection there as a hand of the other side. Both are started here.
    """
    hand, image = scene.hands[row], scene.image_for(row)
    at = image.depth_m, image.k, hand.palm_m
    side, start = hand.track.side, scene.model.detector.start
    wait = start(*at, side, hand.up_m)
    if not comparison_due(hand.track):
        return lambda: SideDetection(wait(), side, row)
    mirrored = start(*at, OTHER_SIDE[side], hand.up_m)
    return lambda: SideDetection(wait(), side, row, mirrored())


def _elsewhere(
    scene: Scene, state: TrackerState, places: Places, rare: bool
) -> list[SideDetection]:
    """The detections at the finder's places as hands of each missing side, those of the largest
    merit first; while there is no track and nobody said a side, see held_out_first.

    rare: the last frame was long ago, see _RARE_S.
    """
    seen: list[SideDetection] = []
    for side in sorted(_missing_sides(scene, state, rare), reverse=True):  # right first
        # A hand that is hardly seen may look like one of the other side.
        others = [hand.palm_m for hand in scene.hands if hand.track.side != side and not rare]
        there = _apart_from(others, places)
        if len(there.centre_m):
            image = scene.image if rare else scene.unexplained
            found = scene.model.detector.look(image.depth_m, image.k, there, side)
            seen += [SideDetection(one, side) for one in found]
    seen.sort(key=lambda one: -one.detection.merit)
    return seen if scene.hands or state.told else held_out_first(seen)


def _missing_sides(scene: Scene, state: TrackerState, rare: bool) -> set[str]:
    """The sides of hands that are looked for at the finder's places.  rare: see _elsewhere."""
    tracks, slots = [hand.track for hand in scene.hands], len(state.slots)
    if slots > 2:  # of any side, until all hands that are asked for are found
        return set() if sum(track.reliable for track in tracks) >= slots else set(OTHER_SIDE)
    if not tracks:
        return {state.told} if slots == 1 and state.told else set(OTHER_SIDE)
    missing = {track.side for track in tracks if rare or not track.reliable}
    confirmed = [track for track in tracks if track.confirmed]
    if len(confirmed) == 1 and confirmed[0].reliable:  # else what is seen may be its hand
        missing.add(OTHER_SIDE[confirmed[0].side])
    return missing


def _arms(scene: Scene, seen: Sequence[SideDetection]) -> list[tuple[Arm, float]]:
    """Arms, each with the merit up to which a detection on it is taken for the arm itself.

    They are those of hands `seen` at tracks, if their merit is not low, and of reliable tracks that
    nobody looked at. A track that is not reliable may itself be on an arm, and the detection be the
    hand: only a detection of less merit than the track's own is then taken for the arm.
    """
    arms = []
    for one in seen:
        own = one.detection.merit
        if own >= scene.model.detector.settings.merit:
            reliable = scene.hands[one.row].track.reliable
            arms.append((scene.arm(one.detection), math.inf if reliable else own))
    looked = {one.row for one in seen}
    for row, hand in enumerate(scene.hands):
        if row not in looked and hand.track.reliable:
            along = -hand.up_m / max(float(np.linalg.norm(hand.up_m)), 1e-6)
            arms.append(((hand.joints_m[0].numpy(), along), math.inf))
    return arms


def _is_on(arm: Arm, detection: Detection) -> bool:
    """Whether a detected palm lies on an arm, which may itself look like a hand."""
    away = detection.centre_m.numpy() - arm[0]
    along = float(away @ arm[1])
    beside = float(np.linalg.norm(away - along * arm[1]))
    return 0 < along < _ARM_M and beside < _ARM_RADIUS_M


def _apart_from(known: Sequence[np.ndarray], places: Places) -> Places:
    """The places that are farther than SAME_PLACE_M from each known point (3,)."""
    rows = [
        row
        for row, at in enumerate(places.centre_m)
        if all(np.linalg.norm(at - one) > SAME_PLACE_M for one in known)
    ]
    return Places(places.centre_m[rows], places.probability[rows])


def held_out_first(seen: Sequence[SideDetection]) -> list[SideDetection]:
    """The detections, but first the nearest to the camera of those seen about as well as the best:
    where nobody said which hand is meant, it is the one that is held out.
    """
    if not seen:
        return []
    most = max(_WELL_M, _AS_WELL * min(_error_m(one.detection) for one in seen))
    alike = [one for one in seen if _error_m(one.detection) < most]
    first = min(alike, key=lambda one: float(one.detection.centre_m[2]))
    return [first, *(one for one in seen if one is not first)]


def _error_m(detection: Detection) -> float:
    return float(detection.error_m[0])
