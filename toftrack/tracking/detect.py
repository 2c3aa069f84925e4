"""When and where a hand is detected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from toftrack.compute.pace import Duration
from toftrack.detector.hand_detector import NO_DETECTION, Detection, DetectorSettings
from toftrack.detector.proposals import SAME_PLACE_M
from toftrack.frames import DepthImage
from toftrack.render.segmentation import Expected
from toftrack.tracking.confidence import log_odds
from toftrack.tracking.filter import predicted_palm
from toftrack.tracking.handedness import OTHER_SIDE
from toftrack.tracking.hands import OtherHand
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.state import HandState, Track

_AS_WELL = 1.3
"""Hands are seen about as well when their expected errors differ by less than this factor ..."""
_WELL_M = 0.02
"""... or are both smaller than this."""
_IN_FRONT_M = 0.03
"""What is so much nearer than a hidden hand is what hides it."""
_STEP_M, _SPEED_M_S = 0.04, 0.25
"""How far a hand has moved since it was last believed: at once, and a second."""
_ANYWHERE = -1.5
"""Log probability of a place if the hand was not where it was last believed."""
RARE_S = 0.1
"""After so long a prediction says little: the hand is found anew in the whole image as well."""
FORGOTTEN_S = 1.0
"""After so long nothing is known of where a hand is that was believed."""
_AGAIN_S, _WATCHED_AGAIN_S = 1.5, 6.0
"""What was taken for a hand and was none is left alone for so long, if it stays where it is."""


def search_due(hand: HandState, model: TrackerModel, dt_s: float = 0.0) -> bool:
    """Whether the whole image is searched: while no hand is believed, or where frames are rare."""
    if hand.track is not None and not hand.track.doubted:
        return dt_s > RARE_S
    frames = model.detector.settings.search
    return frames == 1 or Duration(hand.searched_s).reached(frames)


def detection_due(track: Track, settings: DetectorSettings, dt_s: float) -> bool:
    """Whether the pose network is asked about a hand that is followed; not always if it is sure."""
    sure = not track.doubted and track.log_odds > log_odds(settings.sure)
    waited = Duration(track.unseen_s + dt_s).reached(settings.every)
    return not sure or waited


def search(
    hand: HandState, image: DepthImage, others: Sequence[OtherHand], model: TrackerModel
) -> Detection:
    """The hand in the whole image that may be this one, or NO_DETECTION."""
    detector, side, least = model.detector, hand.side, model.detector.settings.merit
    likely = partial(reachable, hand, [other.centre_m for other in others])
    found = detector.search(image.depth_m, image.k, side, likely)
    found = [one for one in found if one.merit > least]
    undecided = not hand.handedness.given
    alone = hand.track is None and not any(other.believed for other in others)
    of_other: list[Detection] = []
    if undecided and alone and (not found or not hand.seen.ever):
        # A hand of the other side may be too unlike one of this to be found as such.
        mirrored = detector.search(image.depth_m, image.k, OTHER_SIDE[side], likely)
        mirrored = [one for one in mirrored if one.merit > least]
        of_other = [
            one
            for one in mirrored
            if all((one.centre_m - it.centre_m).norm() > SAME_PLACE_M for it in found)
        ]
        found = [*found, *of_other]
    if undecided and not hand.seen.ever:
        found = held_out(found)
    if not found:
        return NO_DETECTION
    if not any(found[0] is one for one in of_other):
        return found[0]
    centre, up = found[0].centre_m.numpy()[None], np.asarray(found[0].up)[None]
    return detector.detect(image.depth_m, image.k, centre, side, up)[0]


def detect(
    hand: HandState, track: Track, image: DepthImage, model: TrackerModel, dt_s: float
) -> Detection:
    """What the pose network says where a hand is predicted."""
    fitted = model.hand(hand.side, hand.shape)
    centre, up = predicted_palm(track, dt_s, fitted, model)
    return model.detector.detect(image.depth_m, image.k, centre, hand.side, up)[0]


def start_detection(
    hand: HandState, track: Track, image: DepthImage, model: TrackerModel, dt_s: float
) -> Callable[[], Detection]:
    """The same, begun beside whatever does not need it; what is returned waits for it."""
    fitted = model.hand(hand.side, hand.shape)
    centre, up = predicted_palm(track, dt_s, fitted, model)
    return model.detector.start(image.depth_m, image.k, centre[0], hand.side, up[0])


def is_elsewhere(
    detection: Detection, hand: HandState, track: Track, model: TrackerModel, dt_s: float
) -> bool:
    """Whether a hand was detected at another place than where a track is predicted."""
    if detection.empty:
        return False
    centre = predicted_palm(track, dt_s, model.hand(hand.side, hand.shape), model)[0][0]
    return bool(np.linalg.norm(detection.centre_m.numpy() - centre) > SAME_PLACE_M)


def expected_of(detection: Detection) -> Expected:
    """Where a hand is to be segmented that is not tracked yet."""
    joints = detection.joints_m[0]
    nearest, farthest = map(float, joints[:, 2].aminmax())
    return Expected(nearest, farthest, tuple(detection.centre_m.tolist()))


def held_out(found: Sequence[Detection]) -> list[Detection]:
    """The nearest of those hands that are seen about as well as the best one.

    Where nobody said which hand is meant, it is the one that is held out to the camera.
    """
    if not found:
        return []
    most = max(_WELL_M, _AS_WELL * min(float(one.error_m[0]) for one in found))
    alike = [one for one in found if float(one.error_m[0]) < most]
    return [min(alike, key=lambda one: float(one.centre_m[2]))]


def reachable(
    hand: HandState,
    others_m: Sequence[np.ndarray],
    centre_m: np.ndarray,
    apart_m: float = SAME_PLACE_M,
) -> float:
    """How likely a hand has come to a place from where it was last believed, log scale.

    Another hand, or the thing that hides the hand, is no place that it has jumped to; nor what was
    just taken for it and was none.

    others_m: (3,) each, the middles of other hands.  apart_m: nearer to one, it is that hand.
    """
    if any(np.linalg.norm(other - centre_m) < apart_m for other in others_m):
        return -np.inf
    patience = _WATCHED_AGAIN_S if hand.watched else _AGAIN_S
    tried = hand.tried.age_s < patience
    if tried and np.linalg.norm(hand.tried.centre_m - centre_m) < SAME_PLACE_M:
        return -np.inf
    # What was never believed may be a thing, and what is nearer the hand.
    believed = hand.track if hand.believed else None
    if believed is not None and centre_m[2] < believed.nearest_m - _IN_FRONT_M:
        return -np.inf
    if hand.seen.age_s >= FORGOTTEN_S:
        return 0.0
    away = float(np.linalg.norm(hand.seen.centre_m - centre_m))
    near = -0.5 * (away / (_STEP_M + _SPEED_M_S * hand.seen.age_s)) ** 2
    # Or it was never there.
    return max(near, _ANYWHERE - float(np.logaddexp(0.0, hand.seen.surest)))
