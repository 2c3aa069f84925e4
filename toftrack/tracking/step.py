"""The tracker's step: a state and an image in, the next state and an estimate of each hand out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from toftrack.compute.spans import Spans
from toftrack.compute.threads import small_operations
from toftrack.estimate import Estimate
from toftrack.frames import DepthImage
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
from toftrack.tracking.hands import Neighbour, PlacedHand, neighbours_of, partnered, seen_in
from toftrack.tracking.lifecycle import (
    Absence,
    close,
    goes_on,
    open_hand,
    reconcile,
)
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.reporting import (
    Concluded,
    emitted,
    estimate_of,
    no_hand,
    unseen,
    vacant,
)
from toftrack.tracking.seeking import since_search, sought, start_seeking, taking_part
from toftrack.tracking.select import Choice, select
from toftrack.tracking.state import HandState, StepInfo, Track, TrackerState
from toftrack.tracking.watching import first_estimate, watched_over

Stepped = tuple[TrackerState, tuple[StepInfo | None, ...], tuple[Estimate, ...]]
"""The next state, and for each slot what was seen, None where nobody asked, and the estimate."""


@dataclass(frozen=True, eq=False)
class HandTask:
    """All that a hand's part of a frame needs, but for the model.

    others: as the frame begins.
    """

    slot: int
    hand: HandState
    others: tuple[Neighbour, ...]
    image: DepthImage
    dt_s: float
    generator: torch.Generator


@small_operations()
def step(state: TrackerState, image: DepthImage, model: TrackerModel) -> Stepped:
    """One frame of one hand or two; a pure function: the state given stays as it is.

    A particle filter with data-driven proposals (ICONDENSATION: Isard and Blake, ECCV 1998) and
    local optimisation of few hypotheses (Gall et al., IJCV 87, 2010). For each hand:

    1. Predict it, and *open*: detect (a network that votes for joints, as A2J: Xiong et al., ICCV
       2019), compare the sides, segment, begin a track.
    2. Filter: N particles (N, 6 + d) in the pose space, resampled, diffused and weighed by the
       F-measure of the image, in annealed passes (Deutscher and Reid, IJCV 61, 2005).
    3. Wait for detections that ran beside it.
    4. *Propose*: a table of hypotheses (M, 27), refined by Levenberg-Marquardt steps, scored by the
       posterior.
    5. *Select* the best pose.
    6. *Close*: steady the pose, judge it, carry the track on or end it, learn the hand's shape.

    Two hands know of each other where they are predicted; at the end their slots are reconciled.
    """
    spans, generator, dt_s = Spans(), state.resumed(), state.elapsed_s(image)
    before = state.at(image)
    with spans("detector"):
        before, seeking = start_seeking(before, image, model, dt_s)
    found = followed(before, image, model, dt_s, generator, spans)
    with spans("detector"):
        before = sought(before, seeking, model)
    if seeking is not None:  # what it has found meanwhile
        seekings = [hand.seeking for hand in before.hands]
        found = [(s, replace(hand, seeking=seekings[s]), i, e) for s, hand, i, e in found]
    before = replace(before, generator=generator.get_state())
    return reconciled(before, found, image, model, dt_s, spans)


def followed(
    state: TrackerState,
    image: DepthImage,
    model: TrackerModel,
    dt_s: float,
    generator: torch.Generator,
    spans: Spans,
) -> list[Concluded]:
    """The hands that a frame is about after it, the surest first."""
    hands = partnered(state.hands, model)
    slots = taking_part(state, model.configured.handedness.watch_s)
    dice = [generator] + [_seeded_by(generator) for _ in slots[1:]]

    def tasks() -> list[HandTask]:
        others = neighbours_of(hands, slots, image, model, dt_s)
        each = zip(slots, dice, strict=True)
        return [HandTask(slot, hands[slot], others[slot], image, dt_s, own) for slot, own in each]

    with spans("detector"):
        todo = tasks()
    both_go_on = len(todo) == 2 and all(goes_on(task.hand, task.others, dt_s) for task in todo)
    opened = list[HandFrame | Absence]()
    for number, slot in enumerate(slots):
        with spans("detector"):
            task = todo[number]
            others = seen_in(task.others, image, model)
            opened.append(open_hand(slot, task.hand, others, image, model, dt_s))
            track = opened[-1].track
            if track is not hands[slot].track and not both_go_on:  # the next one must know
                hands[slot] = replace(opened[-1].hand, track=track)
                todo = tasks()
    return [concluded(one, task, model, spans) for one, task in zip(opened, todo, strict=True)]


def _seeded_by(generator: torch.Generator) -> torch.Generator:
    """Another one: a hand's random numbers do not depend on how many the other one uses."""
    return torch.Generator().manual_seed(int(torch.randint(2**62, (1,), generator=generator)))


def concluded(
    opened: HandFrame | Absence, task: HandTask, model: TrackerModel, spans: Spans
) -> Concluded:
    """A slot's hand after a frame that it was opened for."""
    image, dt_s, generator = task.image, task.dt_s, task.generator
    if isinstance(opened, Absence):
        return no_hand(opened, image, model)
    with spans("filter: rest"):
        filtered = filtered_frame(opened, dt_s, generator, spans)
    with spans("detector"):
        frame = waited_for(opened, image)
    if frame.track is not opened.track:  # the side has changed
        with spans("filter: rest"):
            filtered = filtered_frame(frame, dt_s, generator, spans)
    with spans("refinement"):
        candidates = FilteredFrame.of(frame, filtered.mean)
        table = propose(candidates)
        choice = select(table, frame.fitted.refiner.joints(table.pose), frame.hidden)
    return conclude(frame, filtered, choice, image, dt_s)


def filtered_frame(
    frame: HandFrame, dt_s: float, generator: torch.Generator, spans: Spans
) -> Filtered:
    """The particles of a hand in a frame."""
    return run_filter(frame.track, dt_s, frame.image, frame.model, generator, spans)


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


def conclude(
    frame: HandFrame, filtered: Filtered, choice: Choice, image: DepthImage, dt_s: float
) -> Concluded:
    """A slot's hand after a frame, from the pose that was chosen."""
    model, track, seen = frame.model, frame.track, frame.observation
    pose, trend = choice.pose, track.trend
    if choice.moved:
        begun = new_track(pose, model)
        track = replace(begun, believed=track.believed)
        trend = begun.trend
    elif model.refinement.iterations:
        pose, trend = steadied(pose, track.pose, trend, dt_s, model.backend.motions)
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
    if frame.detection.empty or frame.hidden or shape.applied != fitted.applied:
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
    seen: dict[int, Estimate] = {}
    for slot, hand, info, estimate in found:
        hands[slot], seen[slot] = hand, estimate
        infos[slot] = replace(info, seconds=spans.seconds())
    second_s = since_search(before, [slot for slot, _, _, _ in found])
    after = replace(before, hands=tuple(hands), second_s=second_s)

    def place(hand: HandState, track: Track) -> PlacedHand:  # of its image nothing is asked
        return PlacedHand(track.pose, model.hand(hand.side, hand.shape), np.eye(3), (1, 1))

    after, exchanged = reconcile(before, after, place, dt_s)
    if before.watched:
        after = watched_over(after, model.configured.handedness)
        first = seen[0] if 0 in seen else unseen(before.hands[0], image, model)
        return after, tuple(infos[:1]), (first_estimate(first, after),)
    slots = list(range(len(hands)))
    if exchanged:
        infos, slots = infos[::-1], slots[::-1]
    estimates = [
        vacant(image, model) if hand.track is None or slot not in seen else seen[slot]
        for slot, hand in zip(slots, after.hands, strict=True)
    ]
    return after, tuple(infos), tuple(estimates)
