"""The tracker's step: a state and an image in, the next state and an estimate of each hand out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from toftrack.compute.spans import Spans
from toftrack.compute.threads import small_operations
from toftrack.estimate import Estimate
from toftrack.frames import DepthImage
from toftrack.refinement import shape_fit
from toftrack.refinement.steadying import steadied
from toftrack.tracking.association import assign, costs, same_hand, sureness, track_ends, unassigned
from toftrack.tracking.belief import judge
from toftrack.tracking.candidates import View, keypoints_of, propose
from toftrack.tracking.confidence import confidence_features
from toftrack.tracking.detect import finish_detection, start_detection
from toftrack.tracking.filter import (
    ParticleSet,
    PoseEstimate,
    new_track,
    predict,
    predict_particles,
    run_filter,
    shift_particles,
    update_velocity,
)
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.report import TrackResult, report
from toftrack.tracking.scene import Scene
from toftrack.tracking.select import select
from toftrack.tracking.state import NO_PLACES, StepInfo, Track, TrackerState
from toftrack.tracking.views import begin_tracks, continue_track, max_new_tracks, predicted_view

StepResult = tuple[TrackerState, tuple[StepInfo | None, ...], tuple[Estimate, ...]]
"""The next state, and for each slot what was seen, None where nothing was, and the estimate."""


@small_operations()
def step(state: TrackerState, image: DepthImage, model: TrackerModel) -> StepResult:
    """One frame of all hands; a pure function: the state given stays as it is.

    Tracking by detection (SORT: Bewley et al., ICIP 2016) of hands that are each followed by a
    particle filter with data-driven proposals (ICONDENSATION: Isard and Blake, ECCV 1998) and local
    optimisation of few hypotheses (Gall et al., IJCV 87, 2010):

    1. Predict where the tracks' hands are, and whose the pixels are.
    2. Detect: a network that votes for joints (A2J: Xiong et al., ICCV 2019) looks at each track's
       place, and where another one that sees the whole image finds a hand that no track explains.
    3. Associate detections with tracks; what is left over begins tentative ones.
    4. Filter: N particles (N, 6 + d) of each track in the pose space, resampled, diffused, weighed
       by the F-measure of the image, in annealed passes (Deutscher and Reid, IJCV 61, 2005).
    5. Refine a few hypotheses (M, 27) by Levenberg-Marquardt steps; the best posterior is the pose.
    6. Judge it, learn the hand's shape, and end what nobody sees any more.
    7. Report the tracks in the slots that the user asked for.
    """
    spans, generator, dt_s = Spans(), state.random_generator(), state.elapsed_s(image)
    before = state.at(image)
    with spans("detector"):
        scene = Scene.of(before.tracks, image, dt_s, model)
        asked = start_detection(scene, before)
        views = [predicted_view(scene, row) for row in range(len(scene.hands))]
    dice = _dice(generator, len(views) + max_new_tracks(before))
    early = dict[int, ParticleSet]()
    if not asked.at_once:  # the networks need nothing of it, and it needs little of them
        shown = {slot.track for slot in before.slots}
        early = {
            row: filter_track(view, dt_s, dice[row], spans, view.track.number in shown)
            for row, view in enumerate(views)
            if view is not None
        }
    with spans("detector"):
        seen, asked = finish_detection(asked, scene, before)
        taken = assign(costs(scene.hands, seen, dt_s))
        views = [
            continue_track(scene, row, view, seen[column] if column >= 0 else None, before.told)
            for row, (view, column) in enumerate(zip(views, taken, strict=True))
        ]
        views += begin_tracks(scene, unassigned(seen, taken), before)
    followed = [
        update_track(view, early.get(row), scene, dice[row], spans)
        for row, view in enumerate(views)
        if view is not None
    ]
    with spans("detector"):
        places = NO_PLACES if asked.finding is None else asked.finding()
    after = replace(
        before,
        places=places,
        found_s=0.0 if asked.found else before.found_s,
        next_track=before.next_track + len(views) - len(taken),
        generator=generator.get_state(),
    )
    after = keep_tracks(after, [one.track for one in followed], model)
    return report(after, followed, scene, spans)


def _dice(generator: torch.Generator, count: int) -> list[torch.Generator]:
    """A generator for each hand: what one draws does not depend on how many there are."""
    seeds = torch.randint(2**62, (count - 1,), generator=generator).tolist()
    return [generator, *(torch.Generator().manual_seed(seed) for seed in seeds)]


def filter_track(
    view: View, dt_s: float, generator: torch.Generator, spans: Spans, shown: bool
) -> ParticleSet:
    """The particles of a frame; of a hand that nobody asked for only moved on."""
    with spans("filter: rest"):
        if not shown:
            return predict_particles(view.track, dt_s, view.model)
        return run_filter(view.track, dt_s, view.image, view.model, generator, spans)


def update_track(
    view: View, early: ParticleSet | None, scene: Scene, generator: torch.Generator, spans: Spans
) -> TrackResult:
    """A track after a frame: its particles filtered, its pose chosen and judged.

    early: its particles as of this frame, if it goes on where it was predicted.
    """
    model, track, dt_s = view.model, view.track, scene.dt_s
    if early is None or track.age.seconds == 0:
        early = filter_track(view, dt_s, generator, spans, shown=True)
    with spans("refinement"):
        table = propose(view, model.decode(early.mean))
        choice = select(table, view.fitted.refiner.joints(table.pose), view.hidden)
    pose, trend = choice.pose, track.trend
    if choice.moved:
        fresh = new_track(pose, model)
        track, trend = replace(track, age=fresh.age, doubtful=fresh.doubtful), fresh.trend
    elif model.refinement.iterations:
        pose, trend = steadied(pose, track.pose, trend, dt_s, model.backend.motions)
    found = PoseEstimate(early, pose, trend, *model.nearest(pose))
    score, joints = view.image.score(pose), view.fitted.refiner.joints(pose)[0]
    age_s, last, seen = track.age.seconds, track.features, view.observation
    features = confidence_features(joints, score, age_s, view.detection, last, seen.depth_m, seen.k)
    status = judge(track, features, dt_s, model.lost)
    # Without refinement the particles stay where they are.
    drawn = shift_particles(found, model) if model.refinement.iterations else early
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
    """The estimate of the hand's shape after a believed estimate of its pose."""
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


def keep_tracks(state: TrackerState, tracks: Sequence[Track], model: TrackerModel) -> TrackerState:
    """The state with the tracks that go on: hands that somebody sees, each of them once."""
    confirmed = [track.confirmed for track in tracks]
    beside = [sum(confirmed) > own for own in confirmed]
    left = [
        track
        for track, other in zip(tracks, beside, strict=True)
        if not track_ends(track, other, model.lost.patience)
    ]
    gone = {track.number for track in tracks} - {track.number for track in left}
    for first in sorted(left, key=sureness, reverse=True):
        for second in left:
            if first.number in gone or second.number in gone or first.number == second.number:
                continue
            if on_same_hand(first, second, model):
                gone.add(min(first, second, key=sureness).number)
    refused = [
        [*palm_of(track, model), 0.0]
        for track in tracks
        if track.number in gone and not track.confirmed
    ]
    return replace(
        state,
        tracks=tuple(track for track in tracks if track.number not in gone),
        refused=np.concatenate((state.refused, np.reshape(refused, (-1, 4)))),
    )


def on_same_hand(first: Track, second: Track, model: TrackerModel) -> bool:
    """Whether two tracks have come onto one hand."""
    joints = [
        model.hand(track.side, track.shape).refiner.joints(track.pose)[0].cpu()
        for track in (first, second)
    ]
    return same_hand(palm_of(first, model), palm_of(second, model), *joints)


def palm_of(track: Track, model: TrackerModel) -> np.ndarray:
    """(3,) the middle of the palm of a track's last pose."""
    return predict(replace(track, velocity=torch.zeros_like(track.velocity)), 0.0, model).palm_m[0]
