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
from toftrack.tracking.association import are_one, assign, costs, ends, left_over, sureness
from toftrack.tracking.belief import judge
from toftrack.tracking.candidates import View, keypoints_of, propose
from toftrack.tracking.confidence import confidence_features
from toftrack.tracking.detect import ask, detected
from toftrack.tracking.filter import (
    Filtered,
    Found,
    drawn_to,
    drifted,
    new_track,
    predict,
    run_filter,
    velocity_after,
)
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.report import Followed, report
from toftrack.tracking.scene import Scene
from toftrack.tracking.select import select
from toftrack.tracking.state import NO_PLACES, StepInfo, Track, TrackerState
from toftrack.tracking.views import begun, continued, most_new, predicted_view

Stepped = tuple[TrackerState, tuple[StepInfo | None, ...], tuple[Estimate, ...]]
"""The next state, and for each slot what was seen, None where nothing was, and the estimate."""


@small_operations()
def step(state: TrackerState, image: DepthImage, model: TrackerModel) -> Stepped:
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
    spans, generator, dt_s = Spans(), state.resumed(), state.elapsed_s(image)
    before = state.at(image)
    with spans("detector"):
        scene = Scene.of(before.tracks, image, dt_s, model)
        asked = ask(scene, before)
        views = [predicted_view(scene, row) for row in range(len(scene.hands))]
    dice = _dice(generator, len(views) + most_new(before))
    early = dict[int, Filtered]()
    if not asked.at_once:  # the networks need nothing of it, and it needs little of them
        shown = {slot.track for slot in before.slots}
        early = {
            row: filtered(view, dt_s, dice[row], spans, view.track.number in shown)
            for row, view in enumerate(views)
            if view is not None
        }
    with spans("detector"):
        seen, asked = detected(asked, scene, before)
        taken = assign(costs(scene.hands, seen, dt_s))
        views = [
            continued(scene, row, view, seen[column] if column >= 0 else None, before.told)
            for row, (view, column) in enumerate(zip(views, taken, strict=True))
        ]
        views += begun(scene, left_over(seen, taken), before)
    followed = [
        follow(view, early.get(row), scene, dice[row], spans)
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
    after = kept(after, [one.track for one in followed], model)
    return report(after, followed, scene, spans)


def _dice(generator: torch.Generator, count: int) -> list[torch.Generator]:
    """A generator for each hand: what one draws does not depend on how many there are."""
    seeds = torch.randint(2**62, (count - 1,), generator=generator).tolist()
    return [generator, *(torch.Generator().manual_seed(seed) for seed in seeds)]


def filtered(
    view: View, dt_s: float, generator: torch.Generator, spans: Spans, shown: bool
) -> Filtered:
    """The particles of a frame; of a hand that nobody asked for only moved on."""
    with spans("filter: rest"):
        if not shown:
            return drifted(view.track, dt_s, view.model)
        return run_filter(view.track, dt_s, view.image, view.model, generator, spans)


def follow(
    view: View, early: Filtered | None, scene: Scene, generator: torch.Generator, spans: Spans
) -> Followed:
    """A track after a frame: its particles filtered, its pose chosen and judged.

    early: its particles as of this frame, if it goes on where it was predicted.
    """
    model, track, dt_s = view.model, view.track, scene.dt_s
    if early is None or track.age.seconds == 0:
        early = filtered(view, dt_s, generator, spans, shown=True)
    with spans("refinement"):
        table = propose(view, model.decode(early.mean))
        choice = select(table, view.fitted.refiner.joints(table.pose), view.hidden)
    pose, trend = choice.pose, track.trend
    if choice.moved:
        fresh = new_track(pose, model)
        track, trend = replace(track, age=fresh.age, doubtful=fresh.doubtful), fresh.trend
    elif model.refinement.iterations:
        pose, trend = steadied(pose, track.pose, trend, dt_s, model.backend.motions)
    found = Found(early, pose, trend, *model.nearest(pose))
    score, joints = view.image.score(pose), view.fitted.refiner.joints(pose)[0]
    age_s, last, seen = track.age.seconds, track.features, view.observation
    features = confidence_features(joints, score, age_s, view.detection, last, seen.depth_m, seen.k)
    status = judge(track, features, dt_s, model.lost)
    # Without refinement the particles stay where they are.
    drawn = drawn_to(found, model) if model.refinement.iterations else early
    track = replace(
        track,
        particles=drawn.particles,
        weights=drawn.weights,
        mean=drawn.mean,
        velocity=velocity_after(track, drawn.mean, dt_s, model),
        pose=found.pose,
        trend=found.trend,
        shape=track.shape if status.lost else learned_shape(view, found),
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
    return Followed(view, track, found, score, status)


def learned_shape(view: View, found: Found) -> shape_fit.ShapeEstimate:
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


def kept(state: TrackerState, tracks: Sequence[Track], model: TrackerModel) -> TrackerState:
    """The state with the tracks that go on: hands that somebody sees, each of them once."""
    confirmed = [track.confirmed for track in tracks]
    beside = [sum(confirmed) > own for own in confirmed]
    left = [
        track
        for track, other in zip(tracks, beside, strict=True)
        if not ends(track, other, model.lost.patience)
    ]
    gone = {track.number for track in tracks} - {track.number for track in left}
    for first in sorted(left, key=sureness, reverse=True):
        for second in left:
            if first.number in gone or second.number in gone or first.number == second.number:
                continue
            if on_one_hand(first, second, model):
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


def on_one_hand(first: Track, second: Track, model: TrackerModel) -> bool:
    """Whether two tracks have come onto one hand."""
    joints = [
        model.hand(track.side, track.shape).refiner.joints(track.pose)[0].cpu()
        for track in (first, second)
    ]
    return are_one(palm_of(first, model), palm_of(second, model), *joints)


def palm_of(track: Track, model: TrackerModel) -> np.ndarray:
    """(3,) the middle of the palm of a track's last pose."""
    return predict(replace(track, velocity=torch.zeros_like(track.velocity)), 0.0, model).palm_m[0]
