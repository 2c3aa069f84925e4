"""The tracker's step: a state and an image in, the next state and an estimate of each hand out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from toftrack.compute import particle_filter
from toftrack.compute.pace import FRAME_S
from toftrack.compute.spans import Spans
from toftrack.compute.threads import small_operations
from toftrack.compute.transfer import on_device, on_host
from toftrack.estimate import Estimate, lost_estimate, no_estimate
from toftrack.frames import DepthImage
from toftrack.gestures.recognition import tell_gesture
from toftrack.hand.conventions import in_all_conventions
from toftrack.hand.shape import HandShape
from toftrack.refinement import shape_fit
from toftrack.refinement.steadying import steadied
from toftrack.tracking.candidates import (
    FilteredFrame,
    HandFrame,
    keypoints_of,
    propose,
    with_parts,
)
from toftrack.tracking.comparing import compared_beside, observed_shape
from toftrack.tracking.confidence import confidence_features, joint_features
from toftrack.tracking.filter import Filtered, Found, new_track, run_filter
from toftrack.tracking.hands import PlacedHand, others_of, partnered
from toftrack.tracking.lifecycle import (
    Absence,
    Status,
    close,
    open_hand,
    reconcile,
)
from toftrack.tracking.model import FilterModel, FittedHand, TrackerModel
from toftrack.tracking.seeking import since_search, sought, start_seeking, taking_part
from toftrack.tracking.select import Choice, Hypotheses, Incumbent, select
from toftrack.tracking.state import HandState, StepInfo, Track, TrackerState
from toftrack.tracking.watching import first_estimate, watched_over

_HIDDEN_WIDER = 2.0
"""By so many times at most a hidden hand is searched farther away than one that is followed."""
Stepped = tuple[TrackerState, tuple[StepInfo | None, ...], tuple[Estimate, ...]]
"""The next state, and for each slot what was seen, None where nobody asked, and the estimate."""
Concluded = tuple[int, HandState, StepInfo, Estimate]
"""A slot and its hand after a frame."""


@small_operations()
def step(state: TrackerState, image: DepthImage, model: TrackerModel) -> Stepped:
    """One frame of one hand or two; a pure function: the state given stays as it is.

    A particle filter with data-driven proposals (ICONDENSATION: Isard and Blake, ECCV 1998) and
    local optimisation of few hypotheses (Gall et al., IJCV 87, 2010). For H hands:

    1. Predict the hands, and *open*: detect (a network that votes for joints, as A2J: Xiong et al.,
       ICCV 2019), compare the sides, segment, begin tracks. -> H frames
    2. Filter: N particles (N, 6 + d) in the pose space, resampled, diffused and weighed by the
       F-measure of the image, in annealed passes (Deutscher and Reid, IJCV 61, 2005).
    3. Wait for detections that ran beside it.
    4. *Propose*: one table of hypotheses (M, 27) of all hands, refined by Levenberg-Marquardt
       steps, scored by the posterior; in a second round the best ones with exchanged fingers.
    5. *Select* a pose for each hand, with hysteresis (Page's test, Biometrika 41, 1954).
    6. *Close*: steady the pose, judge it, carry the track on or end it, learn the hand's shape.
    7. Reconcile the slots of two hands.
    """
    spans, generator, dt_s = Spans(), state.resumed(), state.elapsed_s(image)
    before = state.at(image)
    with spans("detector"):
        before, seeking = start_seeking(before, image, model, dt_s)
        opened = open_hands(before, image, model, dt_s)
    frames = [one for one in opened if isinstance(one, HandFrame)]
    with spans("filter: rest"):
        filtered = [filtered_frame(frame, dt_s, generator, spans) for frame in frames]
    with spans("detector"):
        waited = [waited_for(frame, image) for frame in frames]
    again = [new.track is not old.track for new, old in zip(waited, frames, strict=True)]
    frames = waited
    if any(again):  # the side has changed
        with spans("filter: rest"):
            filtered = [
                filtered_frame(frame, dt_s, generator, spans) if anew else found
                for frame, found, anew in zip(frames, filtered, again, strict=True)
            ]
    with spans("refinement"):
        pairs = list(zip(frames, filtered, strict=True))
        candidates = [FilteredFrame.of(frame, found.mean) for frame, found in pairs]
        table = propose(candidates, generator)
        choices = [choose(row, one, table, dt_s) for row, one in enumerate(candidates)]
    found = [conclude(*pair, one, image, dt_s) for pair, one in zip(pairs, choices, strict=True)]
    found += [no_hand(one, image, model) for one in opened if isinstance(one, Absence)]
    with spans("detector"):
        before = sought(before, seeking, model)
    before = replace(before, generator=generator.get_state())
    return reconciled(before, found, image, model, dt_s, spans)


def open_hands(
    state: TrackerState, image: DepthImage, model: TrackerModel, dt_s: float
) -> list[HandFrame | Absence]:
    """The hands that a frame is about, the surest first; each knows where the others are."""
    hands, opened = partnered(state.hands, model), list[HandFrame | Absence]()
    slots = taking_part(state, model.configured.handedness.watch_s)
    others = others_of(hands, slots, image, model, dt_s)
    for slot in slots:
        opened.append(open_hand(slot, hands[slot], others[slot], image, model, dt_s))
        track = opened[-1].track
        if track is not hands[slot].track:  # it began or ended: the next one must know
            hands[slot] = replace(opened[-1].hand, track=track)
            others = others_of(hands, slots, image, model, dt_s)
    return opened


def filtered_frame(
    frame: HandFrame, dt_s: float, generator: torch.Generator, spans: Spans
) -> Filtered:
    """The particles of a hand in a frame."""
    model, track = frame.model, frame.track
    # A hand that was nearly lost is searched farther away, but not ever farther; one that is hidden
    # not far, or it would be taken for what is seen beside it: its own forearm, first of all.
    wider = track.doubtful.seconds / FRAME_S if model.lost.patience else 0.0
    width = 1.0 + (min(wider, _HIDDEN_WIDER) if frame.hidden else wider)
    return run_filter(track, dt_s, frame.image, model, generator, spans, width)


def waited_for(frame: HandFrame, image: DepthImage) -> HandFrame:
    """The frame with its detection, if that ran beside the filter, with both sides compared, if
    that is due, and with what the detection says of its pixels.
    """
    detection = frame.pending()
    if not detection.empty:
        hand = observed_shape(frame.hand, detection, frame.model)
        frame = replace(frame, hand=hand, detection=detection)
        if frame.mirrored is not None:
            frame = compared_beside(frame, frame.mirrored(), image)
    return with_parts(frame)


def choose(row: int, filtered: FilteredFrame, table: Hypotheses, dt_s: float) -> Choice:
    """The pose of one of the table's hands."""
    frame, track = filtered.frame, filtered.frame.track
    mine, joints = table.of_hand(row), frame.fitted.refiner.joints
    incumbent = Incumbent(
        joints(track.contender) if len(track.contender) else torch.zeros(0, 21, 3),
        track.lead,
        track.challenged,
        track.log_odds,
        not track.age.begun,
        filtered.emerges,
    )
    asked, settings = not frame.detection.empty, frame.model.hysteresis
    return select(mine, joints(mine.pose), incumbent, dt_s, asked, filtered.hidden, settings)


def conclude(
    frame: HandFrame, filtered: Filtered, choice: Choice, image: DepthImage, dt_s: float
) -> Concluded:
    """A slot's hand after a frame, from the pose that was chosen."""
    model, track, seen = frame.model, frame.track, frame.observation
    pose, trend = choice.pose, track.trend
    if choice.moved:
        begun = new_track(pose, model, model.refinement.carry)
        track, trend = replace(begun, believed=track.believed), begun.trend
    elif model.refinement.iterations:
        steadying, motions = model.refinement.steadying, model.backend.motions
        pose, trend = steadied(pose, track.pose, trend, dt_s, steadying, motions)
    track = replace(
        track, contender=choice.contender, lead=choice.lead, challenged=choice.challenged
    )
    found = Found(filtered, pose, trend, *model.nearest(pose))
    score, joints = frame.image.score(pose), frame.fitted.refiner.joints(pose)[0]
    age_s, last = track.age.seconds, track.features
    features = confidence_features(
        joints, score, age_s, frame.detection, last, seen.depth_m, seen.k
    )
    status, track, last_seen = close(replace(frame, track=track), found, features, dt_s)
    estimate = estimate_of(image, found, score, status, frame.fitted, model)
    rows = joint_features(
        estimate.joints_m,
        frame.detection,
        track.joint_features,
        score,
        status.log_odds,
        image.depth_m,  # as the camera took it, and not reduced
        image.k,
    )
    sigma, confidence = model.lost.joints.judge(rows)
    ok = (confidence >= model.lost.joint_ok) & (not status.lost)
    estimate = replace(estimate, joint_sigma_m=sigma, joint_confidence=confidence, joint_ok=ok)
    hand = replace(
        frame.hand,
        shape=frame.hand.shape if status.lost else learned_shape(frame, found),
        track=None if status.ends else replace(track, joint_features=rows),
        seen=last_seen,
    )
    hand, estimate = emitted(hand, image, estimate, frame.fitted.shape, dt_s, model)
    detection = None if frame.detection.empty else frame.detection
    particles, weights = filtered.particles, filtered.weights
    info = StepInfo(seen, particles, weights, {}, features, rows, detection)
    return frame.slot, hand, info, estimate


def learned_shape(frame: HandFrame, found: Found) -> shape_fit.ShapeEstimate:
    """The estimate of the hand's shape after a believed estimate of its pose."""
    shape, fitted, model = frame.hand.shape, frame.fitted, frame.model
    busy = (frame.in_turn or 0) % 2 == 1  # of two hands one learns in a frame
    if busy or frame.detection.empty or frame.hidden or shape.applied != fitted.applied:
        return shape  # of a hand that was given up in this very frame nothing is learned
    return shape_fit.learned(
        shape,
        found.pose,
        fitted.shape,
        fitted.derivatives,
        frame.detection,
        keypoints_of(frame.detection, model),
        model.fit,
        fitted.first,
        fitted.refiner.pose,
    )


def reconciled(
    before: TrackerState,
    found: Sequence[Concluded],
    image: DepthImage,
    model: TrackerModel,
    dt_s: float,
    spans: Spans,
) -> Stepped:
    """What a step returns; of two hands each in its slot, and vacant where none is followed."""
    hands = list(before.hands)
    infos: list[StepInfo | None] = [None] * len(hands)
    estimates = [unseen(hand, before.watched, image, model) for hand in hands]
    for slot, hand, info, estimate in found:
        hands[slot], estimates[slot] = hand, estimate
        infos[slot] = replace(info, seconds=spans.seconds())
    second_s = since_search(before, [slot for slot, _, _, _ in found])
    after = replace(before, hands=tuple(hands), second_s=second_s)
    after, exchanged = reconcile(before, after, partial(_found_hand, model), dt_s)
    if before.watched:
        after = watched_over(after, model.configured.handedness)
        first = first_estimate(estimates[0], after)
        return after, tuple(infos[:1]), (first,)
    if exchanged:
        infos, estimates = infos[::-1], estimates[::-1]
    both = zip(after.hands, estimates, strict=True)
    estimates = [vacant(image, model) if hand.track is None else one for hand, one in both]
    return after, tuple(infos), tuple(estimates)


def _found_hand(model: TrackerModel, hand: HandState, track: Track) -> PlacedHand:
    """A hand where it was found; of its image nothing is asked."""
    return PlacedHand(track.pose, model.hand(hand.side, hand.shape), np.eye(3), (1, 1))


def estimate_of(
    image: DepthImage,
    found: Found,
    score: float,
    status: Status,
    fitted: FittedHand,
    model: FilterModel,
) -> Estimate:
    """The estimate of a frame, but for its joints' deviations and what `emitted` adds."""
    particles, motions = found.filtered.particles, model.backend.motions
    mean = on_device(found.filtered.mean, model.device)
    tangents = motions.difference(particles, mean)
    tangents[:, :3] = particles[:, :3] - mean[:, :3]  # the result speaks of the wrist
    covariance, effective = on_host(
        particle_filter.covariance(tangents, found.filtered.weights),
        particle_filter.effective_sample_size(found.filtered.weights),
    )
    return Estimate(
        index=image.index,
        timestamp_s=image.timestamp_s,
        state_name=status.state_name,
        lost=status.lost,
        confidence=status.confidence,
        outside_rad=found.off_rad,
        joints_m=_host(fitted.refiner.joints(found.pose)[0]),
        state=_host(found.pose[0]),
        latent=_host(model.space.encode(found.pose[:, 6:])[0]),
        score=score,
        covariance=_host(covariance + torch.diag(model.model_variance)),
        effective_sample_size=float(effective),
        compute_s=math.nan,
    )


def emitted(
    hand: HandState,
    image: DepthImage,
    estimate: Estimate,
    shape: HandShape,
    dt_s: float,
    model: FilterModel,
) -> tuple[HandState, Estimate]:
    """The estimate with its gesture, its side and other programs' conventions; and the hand with
    what is kept of them.

    shape: the hand of the estimate.
    """
    gesture, estimate = tell_gesture(
        model.gestures, hand.gesture, estimate, model.space, dt_s / FRAME_S
    )
    size_px = image.depth_m.shape[1], image.depth_m.shape[0]
    estimate = in_all_conventions(_sided(estimate, hand), shape, image.k, size_px)
    # While there is no hand, the last estimate that was believed is reported, if one was.
    kept = hand.last if estimate.lost and not hand.last.lost else estimate
    return replace(hand, gesture=gesture, last=kept), estimate


def no_hand(absence: Absence, image: DepthImage, model: FilterModel) -> Concluded:
    """Nothing in the frame can be a hand: the last estimate stands, and is lost."""
    hand = absence.hand
    estimate = lost_estimate(hand.last, image.index, image.timestamp_s, math.nan)
    gesture, estimate = tell_gesture(model.gestures, None, estimate, model.space)
    none = torch.zeros(0, 6 + model.space.dims, device=model.device)
    info = StepInfo(absence.observation, none, none[:, 0], {})
    return absence.slot, replace(hand, gesture=gesture), info, _sided(estimate, hand)


def unseen(hand: HandState, watched: bool, image: DepthImage, model: FilterModel) -> Estimate:
    """The estimate of a slot that takes no part in a frame."""
    if not watched:
        return vacant(image, model)
    estimate = lost_estimate(hand.last, image.index, image.timestamp_s, math.nan)
    return _sided(tell_gesture(model.gestures, None, estimate, model.space)[1], hand)


def vacant(image: DepthImage, model: FilterModel) -> Estimate:
    """The estimate of a slot without a hand."""
    return no_estimate(image.index, image.timestamp_s, "lost", model.space.dims, math.nan)


def _sided(estimate: Estimate, hand: HandState) -> Estimate:
    probability = hand.handedness.probability(hand.side)
    return replace(estimate, side=hand.side, side_probability=probability)


def _host(tensor: Tensor) -> np.ndarray:
    return tensor.detach().numpy().astype(np.float32)
