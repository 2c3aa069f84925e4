"""When and where a hand is detected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from toftrack.compute.pace import Duration
from toftrack.compute.rigid import pivot_offset
from toftrack.detector.hand_detector import NO_DETECTION, Detection, DetectorSettings
from toftrack.detector.proposals import SAME_PLACE_M
from toftrack.frames import DepthImage
from toftrack.render.segmentation import Expected
from toftrack.tracking.confidence import log_odds
from toftrack.tracking.filter import predicted_palm
from toftrack.tracking.handedness import OTHER_SIDE
from toftrack.tracking.hands import OtherHand
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.state import HandState, LastSeen, Track

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
FORGOTTEN_S = 1.0
"""After so long nothing is known of where a hand is that was believed."""
_OTHER_PLACE_M = 0.1
"""A hand that is so far from where the one that was believed was seen last may be another one."""
_NEAR_M, _DEPTH_M, _MOST = 0.03, 0.05, 0.5
"""It was there already where so many of its joints had a surface so near to them, across the view
and along it: hands move a little meanwhile."""
_ARM_M, _BENT = 0.05, 0.6
"""Half of a forearm's breadth, and the tangent of how far a wrist bends: the arm is the hand's."""
_AGAIN_S, _WATCHED_AGAIN_S = 1.5, 6.0
"""What was taken for a hand and was none is left alone for so long, if it stays where it is."""
_GUESSED, _CUT = 0.2, 0.3
"""Probability of the finder from which on a place is guessed to be a hand, where so many of its
joints are outside of the image. What is in full view and no hand to the pose network is none."""


class Searched(NamedTuple):
    """What a search has found.

    best: the best hand that may be the one that is meant, or NO_DETECTION.
    guess: where there is none, the likeliest place of one that the image's border cuts off.
    """

    best: Detection
    guess: Detection = NO_DETECTION


def search_due(hand: HandState, model: TrackerModel) -> bool:
    """Whether the whole image is searched: while no hand is believed, and not each time if set."""
    if hand.track is not None and not hand.track.doubted:
        return False
    frames = model.detector.settings.search
    return frames == 1 or Duration(hand.searched_s).reached(frames)


def detection_due(track: Track, settings: DetectorSettings, dt_s: float) -> bool:
    """Whether the pose network is asked about a hand that is followed; not always if it is sure."""
    sure = not track.doubted and track.log_odds > log_odds(settings.sure)
    waited = Duration(track.unseen_s + dt_s).reached(settings.every)
    return not sure or waited or track.challenged.begun


def search(
    hand: HandState, image: DepthImage, others: Sequence[OtherHand], model: TrackerModel
) -> Searched:
    """The hand in the whole image that may be this one."""
    detector, side, least = model.detector, hand.side, model.detector.settings.merit
    likely = partial(reachable, hand, [other.centre_m for other in others])
    places = detector.search(image.depth_m, image.k, side, likely)
    found = [one for one in places if one.merit > least]
    undecided = not hand.handedness.given
    alone = hand.track is None and not any(other.believed for other in others)
    of_other: list[Detection] = []
    if undecided and alone and (not found or not hand.seen.ever):
        # A hand of the other side may be too unlike one of this to be found as such.
        mirrored = detector.search(image.depth_m, image.k, OTHER_SIDE[side], likely)
        mirrored = [one for one in mirrored if one.merit > least]
        of_other = [one for one in mirrored if not any(_same_place(one, seen) for seen in found)]
        found = [*found, *of_other]
    if undecided and not hand.seen.ever:
        found = held_out(found)
    if not found:
        possible = [one for one in places if one.heat >= _GUESSED and one.merit > -np.inf]
        possible = [one for one in possible if _is_cut_off(one, image)]
        return Searched(NO_DETECTION, max(possible, key=lambda one: one.heat, default=NO_DETECTION))
    if not any(found[0] is one for one in of_other):
        return Searched(found[0])
    centre, up = found[0].centre_m.numpy()[None], np.asarray(found[0].up)[None]
    return Searched(detector.detect(image.depth_m, image.k, centre, side, up)[0])


def _is_cut_off(detection: Detection, image: DepthImage) -> bool:
    """Whether the border of the image cuts off much of a hand."""
    joints = detection.joints_m[0].numpy()
    place = joints[:, :2] / joints[:, 2:] * image.k[:2, :2].diagonal() + image.k[:2, 2]
    size = np.array(image.depth_m.shape[::-1])
    outside = ((place < -0.5) | (place > size - 0.5)).any(1)
    return bool(outside.mean() > _CUT)


def _same_place(one: Detection, other: Detection) -> bool:
    """Whether two detections are of one hand."""
    return float((one.centre_m - other.centre_m).norm()) < SAME_PLACE_M


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


def was_beside(detection: Detection, seen: LastSeen) -> bool:
    """Whether what is detected was beside a hand and its arm already when that was seen last."""
    if detection.empty or seen.scene is None:
        return False
    particle, centre = seen.particle.numpy(), detection.centre_m.numpy()
    palm = pivot_offset(particle[:, 3:6])[0]
    off, arm = centre - particle[0, :3], -palm / np.linalg.norm(palm)
    along = max(0.0, float(off @ arm))
    if np.linalg.norm(off - palm) < _OTHER_PLACE_M:
        return False
    if np.linalg.norm(off - along * arm) < _ARM_M + _BENT * along:
        return False
    depth, k = seen.scene.depth_m.cpu().numpy(), seen.scene.k.cpu().numpy()
    joints = detection.joints_m[0].double().numpy()
    return sum(_had_surface(joint, depth, k) for joint in joints) > _MOST * len(joints)


def _had_surface(point_m: np.ndarray, depth_m: np.ndarray, k: np.ndarray) -> bool:
    """Whether an image (H, W) has a surface near a point (3,)."""
    u, v = k[:2, :2].diagonal() * point_m[:2] / point_m[2] + k[:2, 2]
    reach_px = _NEAR_M * k[0, 0] / point_m[2]
    rows, columns = (
        slice(max(0, round(c - reach_px)), max(0, round(c + reach_px) + 1)) for c in (v, u)
    )
    return bool((np.abs(depth_m[rows, columns] - point_m[2]) < _DEPTH_M).any())


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
