"""The report of a frame: which track is in which slot, and the estimate of each.

Only here tracks are put into slots. How many slots there are, and which side the user told, also
steer where the networks look (detect.py) and how sides are found out (sides.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from toftrack.compute import particle_filter
from toftrack.compute.pace import FRAME_S, Spans
from toftrack.compute.rigid import bound
from toftrack.compute.threads import small_operations
from toftrack.compute.transfer import on_device, on_host
from toftrack.frames.estimate import Estimate, lost_estimate, no_estimate
from toftrack.frames.frame import DepthImage
from toftrack.gestures.recognition import tell_gesture, without_gesture
from toftrack.hand.conventions import in_all_conventions, with_landmarks
from toftrack.hand.shape import HandShape
from toftrack.tracking.association import least_cost
from toftrack.tracking.candidates import View
from toftrack.tracking.confidence import Status, joint_features, probability
from toftrack.tracking.model import FilterModel, FittedHand
from toftrack.tracking.scene import Scene
from toftrack.tracking.sides import side_log_odds
from toftrack.tracking.state import (
    OTHER_SIDE,
    ParticleSet,
    Slot,
    StepInfo,
    Track,
    TrackerState,
    changed,
)

_OTHER = 0.4
"""A hand that is of the side that the user said with less than this probability is flagged as
another one."""
_STAYS, _CONFIRMED = 2.0, 6.0
"""What a track is worth to a slot, in log odds, for being there before and for being confirmed.
With 4 for being there, an elbow kept the only slot after something had hidden the hand."""
_MOST = 3.0
"""A track's log odds, and those of its side, count up to this either way."""
_GONE_S = 2.0
"""Where no side was said, a hand of the other side takes the only slot when none was believed there
for so long."""


@dataclass(frozen=True, eq=False)
class TrackResult:
    """A track after a frame, and what its estimate is made of.

    view: the track's view in the frame, with the track as it was before.
    filtered: its particles, before they were shifted to the pose.
    score: the F-measure of its pose, 0 .. 1.  status: of its estimate.
    """

    view: View
    track: Track
    filtered: ParticleSet
    score: float
    status: Status


StepResult = tuple[TrackerState, tuple[StepInfo | None, ...], tuple[Estimate, ...]]
"""The next state; per slot what the step saw, None where it saw no hand; per slot the estimate."""


def report(
    state: TrackerState, results: Sequence[TrackResult], scene: Scene, spans: Spans
) -> StepResult:
    """The state with its slots updated, and what each slot reports.

    state: with the tracks that go on.  results: also of those that ended in this frame.
    """
    rights = [side_log_odds(one.track, state.tracks, state.told) for one in results]
    # Tracks that this frame shows nothing of keep their slots, as they go on.
    unseen = {track.number for track in state.tracks} - {one.track.number for one in results}
    reports = list[tuple[Slot, StepInfo | None, Estimate]]()
    for number, row in enumerate(assign_slots(state, results, rights)):
        if row is None:
            slot = state.slots[number]
            slot = slot if slot.track in unseen else changed(slot, track=-1)
            slot, estimate = report_absence(slot, scene.camera_image, scene.model, len(state.slots))
            reports.append((slot, None, estimate))
        else:
            reports.append(report_track(number, results[row], rights[row], state, scene, spans))
    slots, infos, estimates = zip(*reports, strict=True)
    return changed(state, slots=slots), infos, estimates


def assign_slots(
    state: TrackerState, results: Sequence[TrackResult], rights: Sequence[float]
) -> list[int | None]:
    """The row of the result for each slot, None = none, so that their worth is largest in sum.

    rights: log odds of a right hand of each.
    """
    worth = np.zeros((len(state.slots), len(results) + len(state.slots)))
    for number, slot in enumerate(state.slots):
        for row, (one, right) in enumerate(zip(results, rights, strict=True)):
            worth[number, row] = _worth(number, slot, one.track, right, state)
    rows = least_cost(-worth)
    return [row if worth[number, row] > 0 else None for number, row in enumerate(rows)]


def _worth(number: int, slot: Slot, track: Track, right: float, state: TrackerState) -> float:
    """A track's worth to slot `number`; 0 or less where it may not take it.  right: log odds."""
    count, wanted = len(state.slots), side_of_slot(number, state)
    # While nobody knows which hand is meant, tracks that are probably right are worth the same: the
    # first is the one held out (detect.held_out_first), another may just be seen better.
    unknown = count == 1 and wanted is None and slot.known is None
    most = 0.0 if unknown else _MOST
    worth = _CONFIRMED * track.confirmed + min(max(track.log_odds, -_MOST), most) + _MOST
    stays = slot.track == track.number and not unknown
    # Of hands that are worth the same, the one that was found first comes first.
    worth += _STAYS * stays + 0.1 / ((1 + track.number) * (1 + number))
    if count > 2:  # hands of several persons: sides say nothing
        return worth
    if wanted is not None:
        agrees = right if wanted == "right" else -right
        return worth + min(max(agrees, -_MOST), _MOST) + (0 if count == 1 else _MOST)
    if slot.known is None or stays:
        return worth + 0.1
    agrees = right if slot.known == "right" else -right
    if count == 1 and agrees < 0 and slot.away_s < _GONE_S:
        return -1.0  # the hand that was there may come back
    return worth + 0.1 + 0.3 * min(max(agrees, -_MOST), _MOST)


def report_track(
    number: int, one: TrackResult, right: float, state: TrackerState, scene: Scene, spans: Spans
) -> tuple[Slot, StepInfo, Estimate]:
    """Slot `number` with a track's result, the info, and the estimate.

    right: log odds that it is a right hand.
    """
    slot, track, view, model = state.slots[number], one.track, one.view, scene.model
    if slot.track != track.number:
        slot = changed(slot, gesture=None, joint_features=np.zeros_like(slot.joint_features))
    image = scene.camera_image
    estimate = make_estimate(
        image, one.filtered, track.pose, one.score, one.status, view.fitted, model
    )
    score, last = one.score, slot.joint_features
    rows = joint_features(
        estimate.joints_m, view.detection, last, score, track.log_odds, scene.image
    )
    sigma, confidence = model.lost.joints.judge(rows)
    estimate = with_side(estimate, track.side, right, side_of_slot(number, state))
    if estimate.confidence < model.lost.confidence and not estimate.lost:  # by its side
        estimate = estimate.updated(lost=True, state_name="searching")
    estimate = estimate.updated(
        joint_sigma_m=sigma,
        joint_confidence=confidence,
        joint_ok=(confidence >= model.lost.joint_ok) & (not estimate.lost),
    )
    slot, estimate = finish_estimate(slot, image, estimate, view.fitted.shape, scene.dt_s, model)
    # A hand that was found before this one, and is tentative, may be the one held out.
    before = (other for other in state.tracks if other.number < track.number)
    decided = track.confirmed and all(other.confirmed for other in before)
    slot = changed(
        slot,
        track=track.number,
        side=track.side,
        shape=track.shape,
        known=track.side if decided else slot.known,
        away_s=slot.away_s if estimate.lost else 0.0,
        joint_features=rows,
    )
    info = StepInfo(
        view.observation,
        one.filtered.particles,
        one.filtered.weights,
        spans.seconds(),
        track.features,
        rows,
        None if view.detection.empty else view.detection,
    )
    return slot, info, estimate


def side_of_slot(number: int, state: TrackerState) -> str | None:
    """The side that the user said of a slot; None where nobody did, or of several persons."""
    if state.told is None or len(state.slots) > 2:
        return None
    return OTHER_SIDE[state.told] if number else state.told


def with_side(estimate: Estimate, side: str, right: float, wanted: str | None) -> Estimate:
    """The estimate of a hand of a track's `side`; lost where it is not the `wanted` one.

    right: log odds that it is a right hand.  wanted: see side_of_slot.
    """
    sure = probability(right if side == "right" else -right)
    if wanted is None:
        confidence = estimate.confidence * sure
        return estimate.updated(side=side, side_probability=sure, confidence=confidence)
    if probability(right if wanted == "right" else -right) < _OTHER:
        estimate = estimate.updated(lost=True, state_name="other hand")
    return estimate.updated(side=side, side_probability=1.0 if side == wanted else sure)


def report_absence(
    slot: Slot, image: DepthImage, model: FilterModel, count: int
) -> tuple[Slot, Estimate]:
    """A slot without a result, and its lost estimate: the only slot repeats its last one, one of
    several has NaN.
    """
    nothing = no_estimate(image.index, image.timestamp_s, "lost", model.space.dims, math.nan)
    if count > 1:
        return changed(slot, gesture=None), nothing
    estimate = lost_estimate(slot.last, image.index, image.timestamp_s, math.nan)
    height, width = image.depth_m.shape
    estimate = with_landmarks(estimate, image.k, (width, height))
    return changed(slot, gesture=None), without_gesture(estimate)


def make_estimate(
    image: DepthImage,
    filtered: ParticleSet,
    pose: Tensor,
    score: float,
    status: Status,
    fitted: FittedHand,
    model: FilterModel,
) -> Estimate:
    """A frame's estimate of a pose (1, 27), without side, joint deviations and what
    `finish_estimate` adds.
    """
    space = model.space
    latent = space.encode(pose[:, 6:])
    off = pose[:, 6:] - space.decode(bound(latent, space.lower, space.upper, "truncate"))
    (effective,) = on_host(particle_filter.effective_sample_size(filtered.weights))
    return Estimate(
        index=image.index,
        timestamp_s=image.timestamp_s,
        state_name=status.state_name,
        lost=status.lost,
        confidence=status.confidence,
        outside_rad=float(np.sqrt(np.square(off.numpy()).mean())),
        joints_m=_host(fitted.refiner.joints(pose)[0]),
        state=_host(pose[0]),
        latent=_host(latent[0]),
        score=score,
        effective_sample_size=float(effective),
    ).updated(covariance=lambda: covariance_of(filtered, model))


@small_operations()
def covariance_of(filtered: ParticleSet, model: FilterModel) -> np.ndarray:
    """(6 + d, 6 + d) of particles and the hand model's own error, of the wrist, not the pivot."""
    mean = on_device(filtered.mean, model.device)
    tangents = model.backend.motions.difference(filtered.particles, mean)
    tangents[:, :3] = filtered.particles[:, :3] - mean[:, :3]
    (covariance,) = on_host(particle_filter.covariance(tangents, filtered.weights))
    return _host(covariance + torch.diag(model.model_variance))


def finish_estimate(
    slot: Slot,
    image: DepthImage,
    estimate: Estimate,
    shape: HandShape,
    dt_s: float,
    model: FilterModel,
) -> tuple[Slot, Estimate]:
    """The slot with the estimate's gesture, and the estimate with it and in all conventions.

    shape: the hand of the estimate.
    """
    frames, (height, width) = dt_s / FRAME_S, image.depth_m.shape
    gesture, estimate = tell_gesture(model.gestures, slot.gesture, estimate, model.space, frames)
    size_px = width, height
    estimate = in_all_conventions(estimate, shape, image.k, size_px)
    # While there is no hand, the last estimate that was believed is reported, if one was.
    kept = slot.last if estimate.lost and not slot.last.lost else estimate
    return changed(slot, gesture=gesture, last=kept), estimate


def _host(tensor: Tensor) -> np.ndarray:
    return tensor.detach().numpy().astype(np.float32)
