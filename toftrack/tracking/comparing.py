"""The sides of a hand compared, and tracks begun, by the best of the detector's poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from toftrack.detector.hand_detector import Detection
from toftrack.frames import DepthImage
from toftrack.refinement import shape_fit
from toftrack.refinement.shape_fit import first_shape
from toftrack.render.segmentation import Observation
from toftrack.tracking.candidates import (
    HandFrame,
    best_start,
    image_term,
    posterior_of,
    without_things,
)
from toftrack.tracking.detect import expected_of
from toftrack.tracking.filter import new_track
from toftrack.tracking.handedness import OTHER_SIDE, body_offset_m
from toftrack.tracking.hands import OtherHand, pixels_of, without
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.posterior import ImageTerm
from toftrack.tracking.state import HandState, Track

_GONE_S = 1.0
"""A hand that was believed so long ago may have made way for another one."""
_LEAST_SIDE = 1e-4
"""The network is never surer of a side than by this."""
_SWITCHED = 0.45
"""The side is changed when it has become less probable than this, so that it does not flicker."""
_LEAST_PRESENT = 0.5
"""Where a hand is less probable than this, its sides are not compared."""
_LEAST_LOG_ODDS = -1.0
"""Nor are those of a given side's track that is less surely right than this: neither pose is the
hand's, and which one explains more of the image is chance."""


def comparison_due(hand: HandState, model: TrackerModel, dt_s: float) -> bool:
    """Whether both sides of a hand are to be compared in a frame, dt_s after the last."""
    track, settings = hand.track, model.configured.handedness
    if hand.handedness.given and track is not None and track.believed:
        if track.log_odds < _LEAST_LOG_ODDS:
            return False
    return hand.handedness.comparison_due(settings, track is not None, dt_s)


def compared(
    hand: HandState,
    detection: Detection,
    others: tuple[OtherHand, ...],
    image: DepthImage,
    model: TrackerModel,
    dt_s: float,
) -> tuple[HandState, Detection]:
    """A hand of which no track is believed, after its sides were compared, where that is due.

    When the other side has become the likelier one, a track of it begins in this frame.
    """
    settings, before = model.configured.handedness, hand.handedness
    due = comparison_due(hand, model, dt_s)
    if hand.track is None and (before.given or hand.seen.age_s > _GONE_S):
        before = before.left(settings)  # what comes may be the other hand
    hand = replace(hand, handedness=before.waited(dt_s))
    if detection.present < _LEAST_PRESENT or not due:
        return hand, detection
    other, centre = OTHER_SIDE[hand.side], detection.centre_m.numpy()
    up = detection.up[None]
    mirrored = model.detector.detect(image.depth_m, image.k, centre[None], other, up)[0]
    gain = _best_log_posterior(hand, detection, hand.side, others, image, model)
    gain -= _best_log_posterior(hand, mirrored, other, others, image, model)
    gain += settings.network * _said(detection, mirrored, hand.side, image, model)
    hand = _after(replace(hand, handedness=before), gain, detection, image, model)
    return hand, detection if hand.side != other else mirrored


def compared_beside(frame: HandFrame, mirrored: Detection, image: DepthImage) -> HandFrame:
    """The frame of a track after its sides were compared in the image that it has segmented.

    mirrored: what the detector says of the other side, where it says anything of this one.
    When the other side has become the likelier one, a track of it begins in this frame.
    """
    hand, detection, model = frame.hand, frame.detection, frame.model
    if detection.present < _LEAST_PRESENT:
        return frame
    gain = _best_of_side(frame, detection, hand.side)
    gain -= _best_of_side(frame, mirrored, OTHER_SIDE[hand.side])
    weight = model.configured.handedness.network
    gain += weight * _said(detection, mirrored, hand.side, image, model)
    after = _after(hand, gain, detection, without(image, frame.others), model)
    if after.side == hand.side:
        return replace(frame, hand=after)
    expected = expected_of(mirrored)
    other = pixels_of(frame.others)
    observation = model.segmentation(image.depth_m, image.k, expected, other)
    if observation.empty:
        return frame
    after = observed_shape(after, mirrored, model)
    fitted = model.hand(after.side, after.shape)
    return replace(
        frame,
        hand=after,
        track=begun(after, mirrored, observation, frame.others, model),
        fitted=fitted,
        observation=observation,
        expected_m=expected.nearest_m,
        detection=mirrored,
        image=image_term(observation, fitted, model),
    )


def _said(
    detection: Detection, mirrored: Detection, side: str, image: DepthImage, model: TrackerModel
) -> float:
    """How much surer the network is of a side than of the other one, log odds.

    It is asked about the crop of either side's pose, for a crop that is turned as a pose has it
    makes that pose's side the likelier one.
    """
    said = _side_log_odds(detection) - _side_log_odds(mirrored)
    if mirrored.empty:
        return said
    centre, up = mirrored.centre_m.numpy()[None], mirrored.up[None]
    own, other = (
        model.detector.detect(image.depth_m, image.k, centre, one, up)[0]
        for one in (side, OTHER_SIDE[side])
    )
    return 0.5 * (said + _side_log_odds(own) - _side_log_odds(other))


def _side_log_odds(detection: Detection) -> float:
    """That a hand is of the side that was looked for, by the network; 0 where it was not asked.

    Most hands that it was trained on are of that side, which cancels in the difference of both.
    """
    p = min(max(detection.right_side, _LEAST_SIDE), 1 - _LEAST_SIDE)
    return math.log(p / (1 - p))


def _after(
    hand: HandState, gain: float, detection: Detection, image: DepthImage, model: TrackerModel
) -> HandState:
    """The hand after a comparison in which its own side was better by so much; perhaps of the other
    side, and without a track.
    """
    settings, centre = model.configured.handedness, detection.centre_m.numpy()
    gain = gain if hand.side == "right" else -gain
    handedness = hand.handedness.compared(gain, body_offset_m(image, centre), settings)
    hand = replace(hand, handedness=handedness)
    if handedness.probability(hand.side) >= _SWITCHED:  # 1 where the side was given
        return hand
    other = OTHER_SIDE[hand.side]
    return replace(hand, side=other, shape=first_shape(), gesture=None, track=None)


def _best_of_side(frame: HandFrame, detection: Detection, side: str) -> float:
    """The log posterior of the best pose that the detector has for a side of a track's hand."""
    fitted = frame.model.hand(side, frame.hand.shape)
    # As where a track begins, but with what the frame has made of its image.
    image = replace(frame.image, scorer=fitted.scorer, coverage=1.0)
    given = detection, frame.observation, frame.others, frame.model
    keypoints = frame.model.configured.handedness.keypoints
    return _best_start(replace(frame.hand, side=side), *given, image, keypoints)[1]


def _best_log_posterior(
    hand: HandState,
    detection: Detection,
    side: str,
    others: tuple[OtherHand, ...],
    image: DepthImage,
    model: TrackerModel,
) -> float:
    """Of the best pose that the detector has for a side; -inf where nothing can be a hand."""
    observation = model.segmentation(
        image.depth_m, image.k, expected_of(detection), pixels_of(others)
    )
    if observation.empty:
        return -math.inf
    shape = hand.shape
    if hand.track is None:
        first = model.configured.shape
        shape = shape_fit.with_network_length(shape, detection.length_m, model.fit, first)
    hand = replace(hand, side=side, shape=shape)
    keypoints = model.configured.handedness.keypoints
    given = detection, observation, others, model
    return _best_start(hand, *given, keypoints=keypoints)[1]


def begun(
    hand: HandState,
    detection: Detection,
    observation: Observation,
    others: tuple[OtherHand, ...],
    model: TrackerModel,
) -> Track:
    """A track that begins with the best of the detector's poses."""
    pose, _ = _best_start(hand, detection, observation, others, model)
    return new_track(pose, model)


def _best_start(
    hand: HandState,
    detection: Detection,
    observation: Observation,
    others: Sequence[OtherHand],
    model: TrackerModel,
    image: ImageTerm | None = None,
    keypoints: float | None = None,
) -> tuple[Tensor, float]:
    """The best of the detector's poses of a hand, and its log posterior.

    image: the likelihood of that image, if it was made already.  keypoints: see posterior_of.
    """
    fitted, seen = model.hand(hand.side, hand.shape), without_things(observation, detection)
    if image is None or seen is not observation:
        # Very different poses are compared: what explains more of the image counts in full.
        image = image_term(seen, fitted, model, coverage=1.0)
    posterior = posterior_of(seen, fitted, detection, others, model, image, keypoints=keypoints)
    return best_start(detection, seen, fitted, posterior, model)


def observed_shape(hand: HandState, detection: Detection, model: TrackerModel) -> HandState:
    """The hand with what a detection says of its shape: the length to begin a track with, and
    whether it still is the hand that was fitted.
    """
    if detection.empty:
        return hand
    shape, first = hand.shape, model.configured.shape
    if hand.track is None:
        shape = shape_fit.with_network_length(shape, detection.length_m, model.fit, first)
    return replace(hand, shape=shape_fit.contradicted(shape, detection, model.fit, first))
