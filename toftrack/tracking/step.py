"""The tracker's step: from a state and an image to the next state and an estimate per slot."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from toftrack.compute.pace import FRAME_S, Duration, Spans
from toftrack.compute.threads import small_operations
from toftrack.frames.frame import DepthImage
from toftrack.refinement import shape_fit
from toftrack.refinement.steadying import steadied
from toftrack.tracking.association import associate, keep_tracks
from toftrack.tracking.candidates import View, propose, select, with_parts
from toftrack.tracking.confidence import confidence_features, judge
from toftrack.tracking.detect import finish_detection, rests, start_detection
from toftrack.tracking.filter import (
    predict_particles,
    run_filter,
    shift_particles,
    update_velocity,
)
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.report import StepResult, TrackResult, report
from toftrack.tracking.scene import Scene
from toftrack.tracking.state import NO_TREND, ParticleSet, Track, TrackerState, changed
from toftrack.tracking.views import begin_track, continue_track, make_view, max_new_tracks


@small_operations()
def step(state: TrackerState, image: DepthImage, model: TrackerModel) -> StepResult:
    """The next state, and what each slot reports, after one image. It leaves `state` unchanged.

    Tracking by detection (SORT: Bewley et al., ICIP 2016) of hands that are each followed by a
    particle filter with data-driven proposals (ICONDENSATION: Isard and Blake, ECCV 1998) and local
    optimisation of few hypotheses (Gall et al., IJCV 87, 2010):

    1. Thin the image and leave out flying pixels; predict each track's hand, and which track owns
       which pixels.
    2. Filter: resample, diffuse and weigh all tracks' particles (B, N, 6 + d) by the F-measure of
       the image, in annealed passes (Deutscher and Reid, IJCV 61, 2005). Meanwhile
    3. detect: the pose network, which votes for joints (A2J: Xiong et al., ICCV 2019), looks at
       predicted hands, and where the finder, which sees the whole image, finds a hand of no track.
    4. Associate detections with tracks; the unassigned ones begin tentative tracks, whose particles
       are filtered now, as are those of tracks that a detection moves.
    5. Refine a few hypotheses (M, 27) by Gauss-Newton steps; the best posterior is the pose.
    6. Judge it, learn the hand's shape, end tracks that stay doubtful or share another one's hand.
    7. Report the tracks in the slots that the user asked for.
    """
    spans, generator, dt_s = Spans(), state.random_generator(), state.elapsed_s(image)
    state = state.at(image)
    with spans("detector"):
        scene = Scene(state.tracks, image, dt_s, model)
        rows = range(len(scene.hands))
        pending = start_detection(scene, state)
        resting = [rests(scene, row, state) for row in rows]
        predicted = [
            None if resting[row] else make_view(scene, row, hand.track)
            for row, hand in enumerate(scene.hands)
        ]
    with spans("filter: rest"):
        seed = int(torch.randint(2**62, (1,), generator=generator))
        expected = [view and with_parts(view) for view in predicted]
        filtered = filter_tracks([view for view in expected if view], state, scene, seed, spans)
    with spans("detector"):
        detections = finish_detection(pending, scene, state)
        found, new = associate(scene.hands, detections, dt_s)
        continued = [
            continue_track(scene, row, predicted[row], seen, state.told) if seen else expected[row]
            for row, seen in enumerate(found)
        ]
        numbered = list(enumerate(new[: max_new_tracks(state)], state.next_track))
        begun = [begin_track(scene, one, number, state) for number, one in numbered]
        views = [view for view in continued + begun if view is not None]
    with spans("filter: rest"):
        moved = [view for view in views if view.track.cloud not in filtered]
        filtered |= filter_tracks(moved, state, scene, seed, spans)
    results = [update_track(view, filtered[view.track.cloud], scene, spans) for view in views]
    unseen = [
        rest_track(scene, row) if resting[row] else miss_track(scene, row)
        for row in rows
        if continued[row] is None
    ]
    with spans("detector"):
        places = pending.for_next_frame()
    state = changed(
        state,
        places=places,
        searched_s=0.0 if pending.finder_asked else state.searched_s,
        next_track=state.next_track + len(begun),
        generator=generator.get_state(),
    )
    state = keep_tracks(state, [*unseen, *(result.track for result in results)], model)
    return report(state, results, scene, spans)


def rest_track(scene: Scene, row: int) -> Track:
    """The track of a row after a frame in which nothing is compared with it: moved as predicted."""
    hand, dt_s = scene.hands[row], scene.dt_s
    track = hand.track
    return changed(
        track,
        cloud=predict_particles(track, dt_s, scene.model),
        pose=hand.pose,
        age=track.age.extended(dt_s),
    )


def miss_track(scene: Scene, row: int) -> Track:
    """The track of a row after a frame in which no hand can be where it is expected, as one without
    readings: it is doubtful, and so gone after a few of them.
    """
    track, dt_s = scene.hands[row].track, scene.dt_s
    return changed(
        rest_track(scene, row),
        likely=Duration(),
        doubtful=track.doubtful.extended(dt_s, 2 * FRAME_S),
        believed_s=track.believed_s + dt_s,
    )


def filter_tracks(
    views: Sequence[View], state: TrackerState, scene: Scene, seed: int, spans: Spans
) -> dict[ParticleSet, ParticleSet]:
    """The particles of each view's track in this frame, by those of the last one: filtered if a
    slot shows the track or it is not reliable, else moved on.

    What is drawn for a track depends on its number, not on which others there are.
    """
    dt_s, model = scene.dt_s, scene.model
    chosen = [view for view in views if state.shows(view.track) or not view.track.reliable]
    tracks, images = [view.track for view in chosen], [view.image for view in chosen]
    generators = [torch.Generator().manual_seed(seed + track.number) for track in tracks]
    found = run_filter(tracks, dt_s, images, model, generators, spans)
    moved = [view.track for view in views if view not in chosen]
    return {track.cloud: predict_particles(track, dt_s, model) for track in moved} | {
        track.cloud: filtered for track, filtered in zip(tracks, found, strict=True)
    }


def update_track(view: View, filtered: ParticleSet, scene: Scene, spans: Spans) -> TrackResult:
    """The result of a view: its track after the frame, with its pose and how sure that is.

    filtered: the track's particles in this frame.
    """
    model, track, dt_s = view.model, view.track, scene.dt_s
    motions, refines = model.backend.motions, model.refinement.iterations > 0
    with spans("refinement"):
        table = propose(view, model.decode(filtered.mean))
        pose, moved = select(table, view.fitted.refiner.joints(table.pose), view.hidden)
    if moved:
        new = Duration()
        track = changed(track, age=new, likely=new, doubtful=new, trend=NO_TREND)
    elif refines:
        pose, trend = steadied(pose, track.pose, track.trend, dt_s, motions)
        track = changed(track, trend=trend)
    score, joints_m = view.image.score(pose), view.fitted.refiner.joints(pose)[0]
    features = confidence_features(joints_m, score, track, view.detection, view.observation)
    status = judge(track, features, dt_s, model.lost)
    # Without refinement the particles stay where they are.
    drawn = shift_particles(filtered, pose, model) if refines else filtered
    believed = not status.lost
    track = changed(
        track,
        cloud=drawn,
        velocity=update_velocity(track, drawn.mean, dt_s, model),
        pose=pose,
        shape=learn_shape(view, pose) if believed else track.shape,
        age=track.age.extended(dt_s),
        likely=status.likely,
        doubtful=status.doubtful,
        log_odds=status.log_odds,
        whole_odds=status.whole_odds,
        confirmed=track.confirmed or believed,
        believed_s=0.0 if believed else track.believed_s + dt_s,
        asked_s=track.asked_s if view.detection.empty else 0.0,
        parts=track.parts if view.detection.empty else view.detection.parts,
        features=features,
        nearest_m=view.expected_m if view.hidden else 0.0,
    )
    return TrackResult(view, track, filtered, score, status)


def learn_shape(view: View, pose: torch.Tensor) -> shape_fit.ShapeEstimate:
    """The shape estimate of a view's track after a believed pose; as before where it is hidden."""
    shape, fitted, model = view.track.shape, view.fitted, view.model
    unknown = view.detection.empty or view.hidden or shape.applied != fitted.applied
    if unknown or not model.fits:
        return shape
    return shape_fit.learned(
        shape,
        pose,
        fitted.shape,
        fitted.derivatives,
        view.detection,
        view.keypoints,
        fitted.first,
        fitted.refiner.pose,
    )
