"""The tracker's step: a state and an image in, the next state and an estimate out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from toftrack.compute.pace import FRAME_S, elapsed_s
from toftrack.compute.threads import small_operations
from toftrack.estimate import Estimate
from toftrack.frames import DepthImage
from toftrack.relocation.relocaliser import Glance
from toftrack.tracking import shape_fit
from toftrack.tracking.estimates import emitted, estimate_of, no_hand
from toftrack.tracking.following import (
    Found,
    advanced,
    drawn_to,
    expected_depths,
    filtered,
    remembered,
)
from toftrack.tracking.joint_belief import joint_signs
from toftrack.tracking.life_cycle import Belief
from toftrack.tracking.model import LookedFrame, TrackerModel, observed
from toftrack.tracking.other_hand import OtherHand, without
from toftrack.tracking.refining import challenged, refined
from toftrack.tracking.relocating import (
    begun,
    expected_of,
    glanced,
    glancing,
    landmarks_of,
    search_due,
)
from toftrack.tracking.shape_fit import ShapeBelief
from toftrack.tracking.side_belief import probability
from toftrack.tracking.sides import sided
from toftrack.tracking.signs import Signs, read_signs, scored
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
    with spans("relocaliser"):
        alone = without(image, other)
        coming = glancing(state, dt_s, alone, model)
        if coming is None:
            track, glance = glanced(state, dt_s, alone, model, other)
            state = replace(state, unsearched_s=0.0) if search_due(state, model) else state
            state, track, glance = _told(state, track, glance, dt_s, alone, model, other)
        else:
            track, glance = state.track, None
    hand = model.hand(state.side, state.size)
    with spans("segmentation and evidence"):
        expected = expected_depths(track, dt_s, hand, model)
        if expected is None and glance is not None:
            expected = expected_of(glance)
        theirs = None if other is None else other.pixels
        observation = model.segmentation(image.depth_m, image.k, expected, theirs)
        if observation.empty or (glance is None and track is None):
            if coming is not None:
                state = _told(state, track, coming(), dt_s, alone, model, other)[0]
            return no_hand(replace(state, track=None), image, observation, model, spans)
        frame = observed(observation, hand, model, glance, state.seen, other)
    with spans("start"):
        track = begun(frame) if track is None else track
    with spans("filter: rest"):
        # A hand that was nearly lost is looked for farther away, but not ever farther.
        width = 1.0 + (track.bad_s / FRAME_S if model.lost.patience else 0.0)
        particles, weights = filtered(track, dt_s, frame, generator, spans, width)
        mean = model.backend.motions.mean(particles, weights)
    if coming is not None:
        with spans("relocaliser"):
            state, _, glance = _told(state, track, coming(), dt_s, alone, model, other)
            frame = replace(frame, glance=glance)
    with spans("refinement"):
        outcome = refined(track, mean, dt_s, frame, generator)
        track, pose, trend = challenged(track, outcome, dt_s, frame)
    score = frame.score(pose)
    found = Found(particles, weights, mean, pose, trend, *model.nearest(pose), track.offset)
    belief, signs = _believed(track, found, score, state, dt_s, frame)
    unlooked_s = track.unlooked_s + dt_s if frame.glance is None else 0.0
    estimate = estimate_of(image, found, score, belief, frame)
    estimate, seen_signs = _joints_judged(image, estimate, track, belief, frame)
    track = replace(track, signs=signs, joint_signs=seen_signs, unlooked_s=unlooked_s)
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
        frame.observation, particles, weights, spans.seconds(), signs, seen_signs, frame.glance
    )
    return after, info, estimate


def _told(
    state: TrackerState,
    track: Track | None,
    glance: Glance | None,
    dt_s: float,
    image: DepthImage,
    model: TrackerModel,
    other: OtherHand | None,
) -> tuple[TrackerState, Track | None, Glance | None]:
    """What a look at the hand says of its side and its size."""
    state, track, glance = sided(state, track, glance, dt_s, image, model, other)
    return replace(state, size=_hand_told(state, track, glance, model)), track, glance


def _believed(
    track: Track,
    found: Found,
    score: float,
    state: TrackerState,
    dt_s: float,
    frame: LookedFrame,
) -> tuple[Belief, Signs]:
    """What is thought of a frame's estimate, and by which signs."""
    if frame.glance is None:
        # The networks did not look: what they said last still holds. They look at each start.
        assert track.signs is not None
        signs = scored(track.signs, score)
    else:
        joints = frame.hand.refiner.joints(found.pose)[0]
        seen = frame.observation
        signs = read_signs(joints, score, track.age_s, frame.glance, seen.depth_m, seen.k)
    second = frame.other is not None and frame.other.believed
    side = probability(state.sides, state.side)
    return frame.model.lost.judge(track, signs, dt_s, side, second), signs


def _hand_told(
    state: TrackerState, track: Track | None, glance: Glance | None, model: TrackerModel
) -> ShapeBelief:
    """What the networks say of the hand: its length to begin a track with, until estimates say
    better; and whether it still is the hand that was fitted.
    """
    belief = state.size
    if glance is None:
        return belief
    if track is None:
        belief = shape_fit.told(belief, glance.length_m, model.adapt, model.shape)
    return shape_fit.contradicted(belief, glance, model.adapt, model.shape)


def _shape_learned(belief: ShapeBelief, found: Found, frame: LookedFrame) -> ShapeBelief:
    """What is believed of the hand's shape after a believed estimate."""
    model, hand, glance = frame.model, frame.hand, frame.glance
    if glance is None or frame.hidden or belief.worn != hand.worn:
        return belief  # of a hand that was given up in this very frame nothing is learned
    votes = landmarks_of(glance, model)
    return shape_fit.learned(
        belief, found.pose, hand.shape, hand.derivatives, glance, votes, model.adapt, hand.first
    )


def _joints_judged(
    image: DepthImage,
    estimate: Estimate,
    track: Track,
    belief: Belief,
    frame: LookedFrame,
) -> tuple[Estimate, np.ndarray]:
    """The estimate with what is thought of each joint, and by which signs."""
    glance = frame.glance
    signs = joint_signs(
        estimate.joints_m,
        None if glance is None else glance.landmarks,
        track.joint_signs,
        estimate.score,
        belief.log_odds,
        image.depth_m,  # as the camera took it, and not reduced
        image.k,
    )
    sigma, confidence = frame.model.lost.joints.judge(signs)
    return replace(estimate, joint_sigma_m=sigma, joint_confidence=confidence), signs
