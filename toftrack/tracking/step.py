"""The tracker's step: a state and an image in, the next state and an estimate out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from toftrack.compute.pace import FRAME_S, elapsed_s
from toftrack.compute.threads import small_operations
from toftrack.detector.hand_detector import Detection
from toftrack.estimate import Estimate
from toftrack.frames import DepthImage
from toftrack.tracking import shape_fit
from toftrack.tracking.detect import (
    begun,
    detect,
    expected_of,
    keypoints_of,
    search_due,
    start_detection,
)
from toftrack.tracking.estimates import emitted, estimate_of, no_hand
from toftrack.tracking.features import ConfidenceFeatures, confidence_features, scored
from toftrack.tracking.following import (
    Found,
    advanced,
    drawn_to,
    expected_depths,
    filtered,
    remembered,
)
from toftrack.tracking.handedness import sided
from toftrack.tracking.handedness_estimate import probability
from toftrack.tracking.joint_confidence import joint_features
from toftrack.tracking.life_cycle import Status
from toftrack.tracking.model import DetectedFrame, TrackerModel, observed
from toftrack.tracking.other_hand import OtherHand, without
from toftrack.tracking.refining import challenged, refined
from toftrack.tracking.shape_fit import ShapeEstimate
from toftrack.tracking.spans import Spans
from toftrack.tracking.state import StepInfo, Track, TrackerState, resumed


@small_operations()
def step(
    state: TrackerState, image: DepthImage, model: TrackerModel, other: OtherHand | None = None
) -> tuple[TrackerState, StepInfo, Estimate]:
    """One frame: segment, start if there is no hand yet, filter, refine, judge, fit the shape.

    A pure function: the state given stays as it is, and gives the same again.

    other: another hand that is tracked as well; it is not taken for this one.
    """
    spans, generator = Spans(), resumed(state.generator)
    dt_s = elapsed_s(state.timestamp_s, image.timestamp_s)
    state = state.at(image)
    with spans("detector"):
        alone = without(image, other)
        coming = start_detection(state, dt_s, alone, model)
        if coming is None:
            track, detection = detect(state, dt_s, alone, model, other)
            state = replace(state, search_age_s=0.0) if search_due(state, model) else state
            state, track, detection = _updated_hand(
                state, track, detection, dt_s, alone, model, other
            )
        else:
            track, detection = state.track, None
    hand = model.hand(state.side, state.size)
    with spans("segmentation and evidence"):
        expected = expected_depths(track, dt_s, hand, model)
        if expected is None and detection is not None:
            expected = expected_of(detection)
        theirs = None if other is None else other.pixels
        observation = model.segmentation(image.depth_m, image.k, expected, theirs)
        if observation.empty or (detection is None and track is None):
            if coming is not None:
                state = _updated_hand(state, track, coming(), dt_s, alone, model, other)[0]
            return no_hand(replace(state, track=None), image, observation, model, spans)
        frame = observed(observation, hand, model, detection, state.seen, other)
    with spans("start"):
        track = begun(frame) if track is None else track
    with spans("filter: rest"):
        # A hand that was nearly lost is looked for farther away, but not ever farther.
        width = 1.0 + (track.bad_s / FRAME_S if model.lost.patience else 0.0)
        particles, weights = filtered(track, dt_s, frame, generator, spans, width)
        mean = model.backend.motions.mean(particles, weights)
    if coming is not None:
        with spans("detector"):
            state, _, detection = _updated_hand(state, track, coming(), dt_s, alone, model, other)
            frame = replace(frame, detection=detection)
    with spans("refinement"):
        outcome = refined(track, mean, dt_s, frame, generator)
        track, pose, trend = challenged(track, outcome, dt_s, frame)
    score = frame.score(pose)
    found = Found(particles, weights, mean, pose, trend, *model.nearest(pose), track.offset)
    belief, features = _believed(track, found, score, state, dt_s, frame)
    undetected_time_s = track.undetected_time_s + dt_s if frame.detection is None else 0.0
    estimate = estimate_of(image, found, score, belief, frame)
    estimate, joint_row = _joints_judged(image, estimate, track, belief, frame)
    track = replace(
        track, features=features, joint_features=joint_row, undetected_time_s=undetected_time_s
    )
    if model.refinement.iterations:
        found = drawn_to(found, model.refinement.carry, model)
    track = advanced(track, found, belief, expected if frame.hidden else None, dt_s, model)
    size = state.size if belief.lost else _shape_learned(state.size, found, frame)
    state, estimate = emitted(state, image, estimate, hand.shape, dt_s, model, spans)
    after = replace(
        state,
        generator=generator.get_state(),
        track=track if belief.kept else None,
        seen=remembered(state.seen, track, belief, model.lost.probation),
        size=size,
    )
    info = StepInfo(
        frame.observation, particles, weights, spans.seconds(), features, joint_row, frame.detection
    )
    return after, info, estimate


def _updated_hand(
    state: TrackerState,
    track: Track | None,
    detection: Detection | None,
    dt_s: float,
    image: DepthImage,
    model: TrackerModel,
    other: OtherHand | None,
) -> tuple[TrackerState, Track | None, Detection | None]:
    """What a look at the hand says of its side and its size."""
    state, track, detection = sided(state, track, detection, dt_s, image, model, other)
    return replace(state, size=_hand_reported(state, track, detection, model)), track, detection


def _believed(
    track: Track,
    found: Found,
    score: float,
    state: TrackerState,
    dt_s: float,
    frame: DetectedFrame,
) -> tuple[Status, ConfidenceFeatures]:
    """What is thought of a frame's estimate, and by which signs."""
    if frame.detection is None:
        # The networks did not look: what they said last still holds. They look at each start.
        assert track.features is not None
        features = scored(track.features, score)
    else:
        joints = frame.hand.refiner.joints(found.pose)[0]
        seen = frame.observation
        features = confidence_features(
            joints, score, track.age_s, frame.detection, seen.depth_m, seen.k
        )
    second = frame.other is not None and frame.other.believed
    side = probability(state.sides, state.side)
    return frame.model.lost.judge(track, features, dt_s, side, second), features


def _hand_reported(
    state: TrackerState, track: Track | None, detection: Detection | None, model: TrackerModel
) -> ShapeEstimate:
    """What the networks say of the hand: its length to begin a track with, until estimates say
    better; and whether it still is the hand that was fitted.
    """
    belief = state.size
    if detection is None:
        return belief
    if track is None:
        belief = shape_fit.with_network_length(belief, detection.length_m, model.adapt, model.shape)
    return shape_fit.contradicted(belief, detection, model.adapt, model.shape)


def _shape_learned(belief: ShapeEstimate, found: Found, frame: DetectedFrame) -> ShapeEstimate:
    """What is believed of the hand's shape after a believed estimate."""
    model, hand, detection = frame.model, frame.hand, frame.detection
    if detection is None or frame.hidden or belief.applied != hand.applied:
        return belief  # of a hand that was given up in this very frame nothing is learned
    keypoints = keypoints_of(detection, model)
    return shape_fit.learned(
        belief,
        found.pose,
        hand.shape,
        hand.derivatives,
        detection,
        keypoints,
        model.adapt,
        hand.first,
    )


def _joints_judged(
    image: DepthImage,
    estimate: Estimate,
    track: Track,
    belief: Status,
    frame: DetectedFrame,
) -> tuple[Estimate, np.ndarray]:
    """The estimate with what is thought of each joint, and by which signs."""
    detection = frame.detection
    features = joint_features(
        estimate.joints_m,
        None if detection is None else detection.keypoints,
        track.joint_features,
        estimate.score,
        belief.log_odds,
        image.depth_m,  # as the camera took it, and not reduced
        image.k,
    )
    sigma, confidence = frame.model.lost.joints.judge(features)
    return replace(estimate, joint_sigma_m=sigma, joint_confidence=confidence), features
