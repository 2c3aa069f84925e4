"""Views of tracks in a frame: predicted, continued or restarted with a detection, and begun."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from toftrack.compute.pace import Duration
from toftrack.detector.detection import NO_DETECTION, Detection
from toftrack.detector.proposals import SAME_PLACE_M
from toftrack.refinement import shape_fit
from toftrack.refinement.shape_fit import ShapeEstimate, first_shape
from toftrack.render.segmentation import Expected
from toftrack.tracking.association import SideDetection
from toftrack.tracking.candidates import View, best_start, with_parts, without_things
from toftrack.tracking.filter import new_track
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.scene import Scene
from toftrack.tracking.sides import changes_side, compare_sides, side_log_odds
from toftrack.tracking.state import OTHER_SIDE, ParticleSet, Track, TrackerState, changed

_SPARE = 1
"""How many more tracks may exist than slots, or than the two hands of a person."""


def continue_track(
    scene: Scene, row: int, view: View | None, seen: SideDetection, told: str | None
) -> View | None:
    """The predicted `view` of a track with the detection of its hand; None where no hand can be.

    The track restarts where the finder's detection is elsewhere, or the other side is likelier.
    """
    detection, hand = seen.detection, scene.hands[row]
    away = float(np.linalg.norm(detection.centre_m.numpy() - hand.palm_m))
    moved = seen.row < 0 and away > SAME_PLACE_M
    if moved:
        view = make_view(scene, row, hand.track, detection)
    if view is None:
        return None
    track = update_shape(view.track, detection, scene.model)
    view = replace(view, detection=detection, track=track)
    view = restarted(view) if moved else with_parts(view)
    if seen.mirrored is None:
        return view
    return choose_side(scene, row, view, seen.mirrored, told)


def max_new_tracks(state: TrackerState) -> int:
    """How many tracks may begin, so that no more are tentative than hands are missing, or one."""
    confirmed = sum(track.confirmed for track in state.tracks)
    most = max(len(state.slots), 2)
    tentative = len(state.tracks) - confirmed
    return max(0, min(max(most - confirmed, 1) - tentative, most + _SPARE - len(state.tracks)))


def begin_track(scene: Scene, one: SideDetection, number: int, state: TrackerState) -> View | None:
    """The view of a new tentative track with a number; None where no hand can be."""
    model, detection, image = scene.model, one.detection, scene.unexplained
    nothing, shape = torch.zeros(1, 6 + model.space.dims), known_shape(one.side, state)
    cloud, pose = ParticleSet(nothing, nothing[:, 0], nothing), torch.zeros(1, 27)
    track = Track(cloud, nothing[0], pose, number=number, side=one.side, shape=shape)
    track = update_shape(track, detection, model)
    view = make_view(scene, -1, track, detection)
    if view is None:
        return None
    at = detection.centre_m.numpy(), OTHER_SIDE[one.side], detection.up
    mirrored = model.detector.start(image.depth_m, image.k, *at)
    return choose_side(scene, -1, restarted(view), mirrored(), state.told)


def known_shape(side: str, state: TrackerState) -> ShapeEstimate:
    """The shape of the last hand in the first slot of a side that has no track now; the mean of the
    population where there is no such slot.
    """
    vacant = (slot for slot in state.slots if slot.side == side and not state.track_of(slot))
    return next((slot.shape for slot in vacant), first_shape())


def make_view(
    scene: Scene, row: int, track: Track, detection: Detection = NO_DETECTION
) -> View | None:
    """The view of a track where it is detected, or without a detection where it is predicted; None
    where no hand can be.  row: of the track's prediction, -1 = of a new track.
    """
    model = scene.model
    expected = scene.hands[row].expected if detection.empty else expected_of(detection)
    observation = scene.segment(expected, row)
    if observation.empty:
        return None
    fitted = model.hand(track.side, track.shape)
    return View(
        track,
        fitted,
        observation,
        expected.nearest_m,
        detection,
        scene.others_joints(row),
        model,
        model.posterior,
    )


def choose_side(scene: Scene, row: int, view: View, mirrored: Detection, told: str | None) -> View:
    """The view after a comparison of its sides; restarted as a hand of the other side where that is
    likelier.

    mirrored: the detection there as a hand of the other side.  told: the side that the user said.
    """
    arm = scene.arm(view.detection)
    evidence = compare_sides(view, mirrored, scene.image_for(row), arm)
    track, tracks = changed(view.track, evidence=evidence), [hand.track for hand in scene.hands]
    if not changes_side(track, side_log_odds(track, tracks, told), told):
        return replace(view, track=track)
    track = changed(track, side=OTHER_SIDE[track.side], shape=first_shape())
    track = update_shape(changed(track, age=Duration()), mirrored, scene.model)
    other = make_view(scene, row, track, mirrored)
    return view if other is None else restarted(other)


def restarted(view: View) -> View:
    """The view with its track at the best pose of its detection, of age 0: still of the same hand.

    A track whose last estimate was not believed is tentative there: an elbow that the finder takes
    for a hidden hand must be as probable as a new hand to be believed.
    """
    seen = without_things(view.observation, view.detection.parts)
    # Very different poses are compared: what explains more of the image counts in full.
    pose, _ = best_start(replace(view, observation=seen, coverage=1.0))
    old = view.track
    track = changed(
        new_track(pose, view.model),
        number=old.number,
        side=old.side,
        evidence=old.evidence,
        shape=old.shape,
        confirmed=old.reliable,
        believed_s=old.believed_s,
    )
    return with_parts(replace(view, track=track))


def update_shape(track: Track, detection: Detection, model: TrackerModel) -> Track:
    """The track with its shape updated: a new one takes the detection's length, and a fit that
    detections contradict is forgotten.
    """
    if detection.empty or not model.fits:
        return track
    shape, first = track.shape, model.configured.shape
    if not track.age.begun:
        shape = shape_fit.with_network_length(shape, detection.length_m, first)
    return changed(track, shape=shape_fit.contradicted(shape, detection, first))


def expected_of(detection: Detection) -> Expected:
    """Where a detected hand is to be segmented."""
    joints = detection.joints_m[0]
    nearest, farthest = map(float, joints[:, 2].aminmax())
    return Expected(nearest, farthest, tuple(detection.centre_m.tolist()))
