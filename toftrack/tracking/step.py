"""The tracker's step: from a state and an image to the next state and an estimate per slot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress

import torch

from toftrack.compute.pace import Spans
from toftrack.compute.threads import small_operations
from toftrack.estimate import Estimate
from toftrack.frames import DepthImage
from toftrack.refinement import shape_fit
from toftrack.refinement.steadying import steadied
from toftrack.tracking.association import assign, costs, keep_tracks, unassigned
from toftrack.tracking.belief import judge
from toftrack.tracking.candidates import View, keypoints_of, propose, select
from toftrack.tracking.confidence import confidence_features
from toftrack.tracking.detect import finish_detection, rests, start_detection
from toftrack.tracking.filter import (
    ParticleSet,
    PoseEstimate,
    PredictedHand,
    new_track,
    predict_particles,
    run_filter,
    shift_particles,
    update_velocity,
)
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.report import TrackResult, report
from toftrack.tracking.scene import Scene
from toftrack.tracking.state import StepInfo, Track, TrackerState
from toftrack.tracking.views import begin_tracks, continue_track, predicted_view

StepResult = tuple[TrackerState, tuple[StepInfo | None, ...], tuple[Estimate, ...]]
"""The next state; per slot what the step saw, None where it has no track; per slot the estimate."""


@small_operations()
def step(state: TrackerState, image: DepthImage, model: TrackerModel) -> StepResult:
    """The next state, and what each slot reports, after one image. It leaves `state` unchanged.

    Tracking by detection (SORT: Bewley et al., ICIP 2016) of hands that are each followed by a
    particle filter with data-driven proposals (ICONDENSATION: Isard and Blake, ECCV 1998) and local
    optimisation of few hypotheses (Gall et al., IJCV 87, 2010):

    1. Predict each track's hand, and which track owns which pixels.
    2. Detect: the pose network, which votes for joints (A2J: Xiong et al., ICCV 2019), looks at
       predicted hands, and where the finder, which sees the whole image, finds a hand of no track.
    3. Associate detections with tracks; the unassigned ones begin tentative tracks.
    4. Filter: resample, diffuse and weigh all tracks' particles (B, N, 6 + d) by the F-measure of
       the image, in annealed passes (Deutscher and Reid, IJCV 61, 2005).
    5. Refine a few hypotheses (M, 27) by Levenberg-Marquardt steps; the best posterior is the pose.
    6. Judge it, learn the hand's shape, end tracks that stay doubtful or share another one's hand.
    7. Report the tracks in the slots that the user asked for.
    """
    spans, generator, dt_s = Spans(), state.random_generator(), state.elapsed_s(image)
    before = state.at(image)
    with spans("detector"):
        scene = Scene.of(before.tracks, image, dt_s, model)
        pending = start_detection(scene, before)
        resting = [rests(scene, row, before) for row in range(len(scene.hands))]
        predicted = [
            None if rest else predicted_view(scene, row) for row, rest in enumerate(resting)
        ]
        detections, pending = finish_detection(pending, scene, before)
        columns = assign(costs(scene.hands, detections, dt_s))
        views = [
            continue_track(
                scene, row, view, detections[column] if column >= 0 else None, before.told
            )
            for row, (view, column) in enumerate(zip(predicted, columns, strict=True))
        ]
        views += begin_tracks(scene, unassigned(detections, columns), before)
        there = [view for view in views if view is not None]
    with spans("filter: rest"):
        particles = filter_tracks(there, before, dt_s, model, generator, spans)
    results = [
        update_track(view, filtered, scene, spans)
        for view, filtered in zip(there, particles, strict=True)
    ]
    with spans("detector"):
        places = pending.finder()
    after = replace(
        before,
        places=places,
        found_s=0.0 if pending.finder_asked else before.found_s,
        next_track=before.next_track + len(views) - len(columns),
        generator=generator.get_state(),
    )
    rested = [
        rest_track(hand, dt_s, model)
        for hand, rest, view in zip(scene.hands, resting, views, strict=False)
        if rest and view is None
    ]
    after = keep_tracks(after, [*rested, *(result.track for result in results)], model)
    return report(after, results, scene, spans)


def rest_track(hand: PredictedHand, dt_s: float, model: TrackerModel) -> Track:
    """A track after a frame in which it is only moved on."""
    moved, track = predict_particles(hand.track, dt_s, model), hand.track
    return replace(
        track,
        particles=moved.particles,
        mean=moved.mean,
        pose=hand.pose,
        age=track.age.extended(dt_s),
        asked_s=track.asked_s + dt_s,
        evidence=replace(track.evidence, age_s=track.evidence.age_s + dt_s),
    )


def filter_tracks(
    views: Sequence[View],
    state: TrackerState,
    dt_s: float,
    model: TrackerModel,
    generator: torch.Generator,
    spans: Spans,
) -> list[ParticleSet]:
    """The particles of tracks: filtered if a slot shows them or they are doubtful, else moved on.

    What is drawn for a track depends on its number, not on which others there are.
    """
    seed = int(torch.randint(2**62, (1,), generator=generator))
    shown = {slot.track for slot in state.slots}
    chosen = [view.track.number in shown or not view.track.reliable for view in views]
    filtered = list(compress(views, chosen))
    found = iter(
        run_filter(
            [view.track for view in filtered],
            dt_s,
            [view.image for view in filtered],
            model,
            [torch.Generator().manual_seed(seed + view.track.number) for view in filtered],
            spans,
        )
    )
    return [
        next(found) if one else predict_particles(view.track, dt_s, model)
        for view, one in zip(views, chosen, strict=True)
    ]


def update_track(view: View, filtered: ParticleSet, scene: Scene, spans: Spans) -> TrackResult:
    """A track after a frame, with its chosen pose and what is thought of it.

    filtered: its particles in this frame.
    """
    model, track, dt_s = view.model, view.track, scene.dt_s
    with spans("refinement"):
        choice = select(propose(view, model.decode(filtered.mean)), view.hidden)
    pose, trend = choice.pose, track.trend
    if choice.moved:
        fresh = new_track(pose, model)
        track, trend = replace(track, age=fresh.age, doubtful=fresh.doubtful), fresh.trend
    elif model.refinement.iterations:
        pose, trend = steadied(pose, track.pose, trend, dt_s, model.backend.motions)
    found = PoseEstimate(filtered, pose, trend, *model.nearest(pose))
    score, joints = view.image.score(pose), view.fitted.refiner.joints(pose)[0]
    age_s, last, seen = track.age.seconds, track.features, view.observation
    features = confidence_features(joints, score, age_s, view.detection, last, seen.depth_m, seen.k)
    status = judge(track, features, dt_s, model.lost)
    # Without refinement the particles stay where they are.
    drawn = shift_particles(found, model) if model.refinement.iterations else filtered
    track = replace(
        track,
        particles=drawn.particles,
        weights=drawn.weights,
        mean=drawn.mean,
        velocity=update_velocity(track, drawn.mean, dt_s, model),
        pose=found.pose,
        trend=found.trend,
        shape=track.shape if status.lost else learn_shape(view, found),
        age=track.age.extended(dt_s),
        doubtful=status.doubtful,
        log_odds=status.log_odds,
        whole_odds=status.whole_odds,
        confirmed=track.confirmed or not status.lost,
        believed_s=track.believed_s + dt_s if status.lost else 0.0,
        asked_s=track.asked_s + dt_s if view.detection.empty else 0.0,
        features=features,
        nearest_m=view.expected_m if view.hidden else 0.0,
    )
    return TrackResult(view, track, found, score, status)


def learn_shape(view: View, found: PoseEstimate) -> shape_fit.ShapeEstimate:
    """The shape estimate of a track, updated by a pose that is believed and unhidden."""
    shape, fitted = view.track.shape, view.fitted
    if view.detection.empty or view.hidden or shape.applied != fitted.applied:
        return shape
    return shape_fit.learned(
        shape,
        found.pose,
        fitted.shape,
        fitted.derivatives,
        view.detection,
        keypoints_of(view.detection, view.model),
        view.model.fit,
        fitted.first,
        fitted.refiner.pose,
    )
