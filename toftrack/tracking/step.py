"""The tracker's step: a state and an image in, the next state and an estimate out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.pace import FRAME_S, elapsed_s
from toftrack.compute.threads import small_operations
from toftrack.compute.transfer import on_device, on_host
from toftrack.estimate import Estimate, lost_estimate, no_estimate
from toftrack.frames import DepthImage
from toftrack.gestures.recognition import tell_gesture
from toftrack.relocation.relocaliser import Glance
from toftrack.render.scoring import Evidence
from toftrack.render.segmentation import Observation
from toftrack.tracking import particle_filter, shape_fit, size_fit
from toftrack.tracking.belief import CalibratedBelief
from toftrack.tracking.conventions import in_all_conventions
from toftrack.tracking.following import (
    Found,
    advanced,
    aged,
    expected_depths,
    filtered,
    remembered,
)
from toftrack.tracking.joint_belief import joint_signs, propagated_sigma
from toftrack.tracking.life_cycle import Belief, LostSettings, believe
from toftrack.tracking.model import ObservedFrame, TrackerModel, observed
from toftrack.tracking.other_hand import OtherHand, without
from toftrack.tracking.refining import refined
from toftrack.tracking.relocating import expected_of, glanced, glancing, landmarks_of, search_due
from toftrack.tracking.shape_fit import ShapeBelief
from toftrack.tracking.side_belief import SideBelief, probability
from toftrack.tracking.sides import sided
from toftrack.tracking.signs import Signs, read_signs, scored
from toftrack.tracking.size_fit import SizeBelief
from toftrack.tracking.spans import Spans
from toftrack.tracking.starting import begin, challenged
from toftrack.tracking.state import StepInfo, Track, TrackerState, resumed


def first_state(model: TrackerModel, seed: int) -> TrackerState:
    """Before any frame."""
    generator = torch.Generator().manual_seed(seed)
    size: SizeBelief | ShapeBelief | None = None
    if model.adapt is not None:
        size = shape_fit.first_belief()
    elif model.fit is not None:
        size = size_fit.first_belief(model.fit)
    sides = None if model.sides is None else SideBelief()
    return TrackerState(generator.get_state(), model.shape.side, sides, size=size)


@small_operations()
def step(
    state: TrackerState, image: DepthImage, model: TrackerModel, other: OtherHand | None = None
) -> tuple[TrackerState, StepInfo, Estimate]:
    """One frame: segment, start if there is no hand yet, filter, refine, judge, fit the size.

    A pure function: the state given stays as it is, and gives the same again.

    other: another hand that is tracked as well; it is not taken for this one.
    """
    spans, generator = Spans(), resumed(state.generator)
    dt_s = elapsed_s(state.timestamp_s, image.timestamp_s)
    state = at(state, image)
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
        nowhere = model.relocaliser is not None and glance is None and track is None
        if observation.empty or nowhere:
            if coming is not None:
                state = _told(state, track, coming(), dt_s, alone, model, other)[0]
            return _without_hand(state, image, observation, model, spans)
        frame = observed(observation, hand, model, glance, state.seen, other)
    with spans("start"):
        track = begin(track, state, dt_s, frame, generator)
    with spans("filter: rest"):
        particles, weights = filtered(track, dt_s, frame, generator, spans)
        mean = model.backend.motions.mean(particles, weights)
    if coming is not None:
        with spans("relocaliser"):
            state, _, glance = _told(state, track, coming(), dt_s, alone, model, other)
            frame = replace(frame, glance=glance)
    with spans("refinement"):
        outcome = refined(track, mean, dt_s, frame, generator)
        track, pose, trend = challenged(track, outcome, dt_s, frame)
    score = frame.score(pose)
    found = Found(particles, weights, mean, pose, trend, *model.nearest(pose))
    side_probability = probability(state.sides, state.side)
    belief, signs = _believed(track, found, score, side_probability, dt_s, frame)
    unlooked_s = 0.0 if frame.glance is not None else track.unlooked_s + dt_s
    estimate = _estimate(image, found, score, belief, frame)
    estimate, seen_signs = _joints_judged(image, estimate, track, found, belief, frame)
    track = replace(track, signs=signs, joint_signs=seen_signs, unlooked_s=unlooked_s)
    track = advanced(track, found, belief, expected if frame.hidden else None, dt_s, model)
    gesture, estimate = tell_gesture(
        model.gestures, state.gesture, estimate, model.space, dt_s / FRAME_S
    )
    size, refused = _sized(state, found, belief, frame, generator)
    estimate = replace(
        estimate,
        side=state.side,
        side_probability=side_probability,
        compute_s=spans.total(),
    )
    size_px = image.depth_m.shape[1], image.depth_m.shape[0]
    estimate = in_all_conventions(estimate, hand.shape, image.k, size_px)
    after = replace(
        state,
        generator=generator.get_state(),
        track=track if belief.kept else None,
        seen=remembered(state.seen, track, belief, model.lost),
        size=size,
        refused=refused,
        gesture=gesture,
        last=_worth_keeping(state.last, estimate),
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


def _worth_keeping(last: Estimate | None, estimate: Estimate) -> Estimate:
    """What is told while there is no hand: the last estimate that was believed, if one was."""
    return last if estimate.lost and last is not None and not last.lost else estimate


def _believed(
    track: Track,
    found: Found,
    score: float,
    side_probability: float,
    dt_s: float,
    frame: ObservedFrame,
) -> tuple[Belief, Signs | None]:
    """What is thought of a frame's estimate, and by which signs."""
    settings, signs = frame.model.lost, track.signs
    if signs is not None:  # the networks did not look: what they said last still holds
        signs = scored(signs, score)
    if frame.glance is not None:
        joints = frame.hand.refiner.joints(found.pose)[0]
        seen = frame.observation
        signs = read_signs(joints, score, track.age_s, frame.glance, seen.depth_m, seen.k)
    if isinstance(settings, CalibratedBelief):
        assert signs is not None  # see TrackerModel
        second = frame.other is not None and frame.other.believed
        return settings.judge(track, signs, dt_s, side_probability, second), signs
    # A pose that nothing refined is one of the space.
    off_rad = 0.0 if frame.model.refinement is None else found.off_rad
    return believe(track, score, off_rad, dt_s, settings), signs


def _hand_told(
    state: TrackerState, track: Track | None, glance: Glance | None, model: TrackerModel
) -> SizeBelief | ShapeBelief | None:
    """What the networks say of the hand: its length to begin a track with, until estimates say
    better; and whether it still is the hand that was fitted.
    """
    belief, fit = state.size, model.adapt
    if fit is None or glance is None or not isinstance(belief, ShapeBelief):
        return belief
    if track is None:
        belief = shape_fit.told(belief, glance.length_m, model.shape)
    return shape_fit.contradicted(belief, glance, fit, model.shape)


def at(state: TrackerState, image: DepthImage) -> TrackerState:
    """The state as time goes on to an image."""
    before = state.timestamp_s
    passed = 0.0 if before is None else max(0.0, image.timestamp_s - before)
    return replace(
        state,
        seen=aged(state.seen, passed),
        unsearched_s=state.unsearched_s + passed,
        next_index=image.index + 1,
        timestamp_s=image.timestamp_s,
    )


def _without_hand(
    state: TrackerState,
    image: DepthImage,
    observation: Observation,
    model: TrackerModel,
    spans: Spans,
) -> tuple[TrackerState, StepInfo, Estimate]:
    """Nothing in the frame can be a hand: the last estimate stands, and is lost.

    A track ends with it, but where a track is never given up: there it waits as it was.
    """
    waits = isinstance(model.lost, LostSettings) and not model.lost.patience
    index, timestamp_s, last = image.index, image.timestamp_s, state.last
    if last is None:
        estimate = no_estimate(index, timestamp_s, "lost", model.space.dims, math.nan)
    else:
        estimate = lost_estimate(last, index, timestamp_s, math.nan)
    gesture, estimate = tell_gesture(model.gestures, None, estimate, model.space)
    none = torch.zeros(0, 6 + model.space.dims, device=model.device)
    info = StepInfo(observation, none, none[:, 0], spans.seconds())
    return (
        replace(state, track=state.track if waits else None, gesture=gesture),
        info,
        replace(
            estimate,
            side=state.side,
            side_probability=probability(state.sides, state.side),
            compute_s=spans.total(),
        ),
    )


def _sized(
    state: TrackerState,
    found: Found,
    belief: Belief,
    frame: ObservedFrame,
    generator: torch.Generator,
) -> tuple[SizeBelief | ShapeBelief | None, int]:
    """What a frame says of the hand's size or shape; and how many starts were refused.

    A believed estimate says how large the hand is; while there is none, another size is tried.
    """
    model, size, refused = frame.model, state.size, state.refused
    if isinstance(size, ShapeBelief):
        return (size if belief.lost else _shape_learned(size, found, frame)), refused
    if model.fit is None or size is None or size.frames >= model.fit.frames:
        return size, refused
    if not belief.lost:
        likelihood = replace(model.likelihood, beta=model.fit.beta)

        def log_scores(states: Tensor, evidence: Evidence) -> Tensor:
            return likelihood.log_score(frame.counts(states, evidence))

        motions, evidence = model.backend.motions, frame.evidence
        size = size_fit.update(
            size, model.fit, found.pose, evidence, log_scores, motions, generator
        )
    elif not belief.kept and size.frames == 0:
        refused += 1
        size = size_fit.retried(model.fit, refused)
    return size, refused


def _shape_learned(belief: ShapeBelief, found: Found, frame: ObservedFrame) -> ShapeBelief:
    """What is believed of the hand's shape after a believed estimate."""
    model, hand, glance = frame.model, frame.hand, frame.glance
    if model.adapt is None or glance is None or frame.hidden or belief.worn != hand.worn:
        return belief  # of a hand that was given up in this very frame nothing is learned
    votes = landmarks_of(glance, model)
    return shape_fit.learned(
        belief, found.pose, hand.shape, hand.derivatives, glance, votes, model.adapt, hand.first
    )


def _estimate(
    image: DepthImage, found: Found, score: float, belief: Belief, frame: ObservedFrame
) -> Estimate:
    """What is told of a frame, but for its gesture and the time that it took."""
    model, mean, particles = frame.model, found.mean, found.particles
    mean = on_device(mean, model.device)
    tangents = model.backend.motions.difference(particles, mean)
    tangents[:, :3] = particles[:, :3] - mean[:, :3]  # the result speaks of the wrist
    covariance, effective = on_host(
        particle_filter.covariance(tangents, found.weights),
        particle_filter.effective_sample_size(found.weights),
    )
    return Estimate(
        index=image.index,
        timestamp_s=image.timestamp_s,
        state_name=belief.state_name,
        lost=belief.lost,
        confidence=belief.confidence,
        outside_rad=found.off_rad,
        joints_m=_host(frame.hand.refiner.joints(found.pose)[0]),
        state=_host(found.pose[0]),
        latent=_host(model.space.encode(found.pose[:, 6:])[0]),
        score=score,
        covariance=_host(covariance + torch.diag(model.model_variance)),
        effective_sample_size=float(effective),
        compute_s=math.nan,
    )


def _joints_judged(
    image: DepthImage,
    estimate: Estimate,
    track: Track,
    found: Found,
    belief: Belief,
    frame: ObservedFrame,
) -> tuple[Estimate, np.ndarray | None]:
    """The estimate with what is thought of each joint, and by which signs."""
    model, glance = frame.model, frame.glance
    if not isinstance(model.lost, CalibratedBelief) or belief.log_odds is None:
        return replace(estimate, joint_sigma_m=_spread(estimate.joints_m, found, frame)), None
    signs = joint_signs(
        estimate.joints_m,
        None if glance is None else glance.landmarks,
        track.joint_signs,
        estimate.score,
        belief.log_odds,
        image.depth_m,  # as the camera took it, and not reduced
        image.k,
    )
    sigma, confidence = model.lost.joints.judge(signs)
    return replace(estimate, joint_sigma_m=sigma, joint_confidence=confidence), signs


def _spread(joints_m: np.ndarray, found: Found, frame: ObservedFrame) -> np.ndarray:
    """(21, 3) standard deviations of joints by the particles alone, as joint_sigma_m has them."""
    model = frame.model
    motions = model.backend.motions

    def joints_of(tangents: Tensor) -> Tensor:
        moved = motions.compose(found.refined.repeat(len(tangents), 1), tangents)
        return frame.hand.refiner.joints(model.decode(moved, found.offset))

    around = motions.difference(found.particles, on_device(found.mean, model.device))
    (covariance,) = on_host(particle_filter.covariance(around, found.weights))
    return propagated_sigma(joints_m, covariance + torch.diag(model.model_variance), joints_of)


def _host(tensor: Tensor) -> np.ndarray:
    return tensor.detach().numpy().astype(np.float32)
