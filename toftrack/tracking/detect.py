"""The networks' part in a frame: where the hand is looked at, how a track begins, its rivals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.rigid import pivot_offset
from toftrack.compute.transfer import on_device
from toftrack.detector.hand_detector import SAME_PLACE_M, Detection, DetectorSettings
from toftrack.frames import DepthImage
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M
from toftrack.refinement.gauss_newton import Keypoints
from toftrack.refinement.seen_points import SeenPoints, seen_points
from toftrack.render.segmentation import Expected
from toftrack.tracking.following import displacement
from toftrack.tracking.handedness_estimate import OTHER_SIDE, comparison_due
from toftrack.tracking.life_cycle import log_odds, reached
from toftrack.tracking.model import DetectedFrame, SizedHand, TrackerModel
from toftrack.tracking.other_hand import OtherHand, touching
from toftrack.tracking.prior import LastSeen
from toftrack.tracking.state import Track, TrackerState

_UNLIKELY = 0.03
"""Hypotheses that are less probable are no rivals."""
_BENT, _BENT_STEPS, _BENT_M, _BENT_RAD = 2, 6, 0.010, 0.8
"""How many hypotheses are bent to the votes, in how many steps; how sure the votes are at best, and
how far an angle may go."""
_NO_WEIGHT = 1e-6
"""Instead of 0, so that deviations stay numbers: kilometres."""
_AS_WELL = 1.3
"""Hands are seen about as well when their expected errors differ by less than this factor."""
_IN_OTHER = 4.0
"""What speaks against a hand that lies wholly in the other one, log scale."""
_LEAST_LOG_PROBABILITY = float(np.log(0.001))
"""The least that the networks' word counts."""
_IN_FRONT_M = 0.03
"""What is so much nearer than a hidden hand is what hides it."""
_STEP_M, _SPEED_M_S = 0.04, 0.25
"""How far a hand has moved since it was last believed: at once, and a second."""
_FORGOTTEN_S = 1.0
_NEAREST_M = 0.15
"""A camera sees nothing nearer."""


def detect(
    state: TrackerState,
    dt_s: float,
    image: DepthImage,
    model: TrackerModel,
    other: OtherHand | None = None,
) -> tuple[Track | None, Detection | None]:
    """The track to go on with, and what the networks say of the hand: where it is, or at the best
    place of all; None where there is no hand, or no need to look.

    A track that is doubted gives way to a hand that is found elsewhere, not where the other one is.
    """
    detector, track, side = model.detector, state.track, state.side
    best = None
    if search_due(state, model):
        likely = partial(_reachable, state.seen, track, other)
        found = detector.search(image.depth_m, image.k, side, likely)
        best = _chosen(found) if state.sides is not None and state.seen is None else _first(found)
        if best is None and track is None and state.sides is not None:
            # A hand of the other side may be too unlike one of this to be found as such.
            found = detector.search(image.depth_m, image.k, OTHER_SIDE[side], likely)
            again = np.array([detection.centre_m.numpy() for detection in found[:1]]).reshape(-1, 3)
            best = _first(detector.detect(image.depth_m, image.k, again, side))
    if track is None:
        return None, best
    if not track.doubted and _sure(track, detector.settings, dt_s):
        return track, None
    centre = _expected_centre(track, dt_s, model)
    if best is not None and np.linalg.norm(best.centre_m.numpy() - centre[0]) > SAME_PLACE_M:
        return None, best
    return track, detector.detect(image.depth_m, image.k, centre, side)[0]


def start_detection(
    state: TrackerState, dt_s: float, image: DepthImage, model: TrackerModel
) -> Callable[[], Detection] | None:
    """The look at a hand that is followed, begun beside whatever does not need it; see `glanced`.

    What is returned waits for it. None where a frame's first question is what the networks say: is
    there a hand, is it this one, of which side; or where they need not look.
    """
    detector, track = model.detector, state.track
    if track is None or track.doubted:
        return None
    if _sure(track, detector.settings, dt_s) or comparison_due(
        state.sides, model.sides, True, dt_s
    ):
        return None
    centre = _expected_centre(track, dt_s, model)
    return detector.start_detection(image.depth_m, image.k, centre[0], state.side)


def _expected_centre(track: Track, dt_s: float, model: TrackerModel) -> np.ndarray:
    """(1, 3) middle of the palm, dt_s after the last frame, camera frame."""
    moved = displacement(track, dt_s, model.filter)[None]
    predicted = model.backend.motions.compose(track.mean, moved).numpy()
    centre: np.ndarray = predicted[:, :3] + pivot_offset(predicted[:, 3:6])
    centre[:, 2] = np.maximum(centre[:, 2], _NEAREST_M)
    return centre


def search_due(state: TrackerState, model: TrackerModel) -> bool:
    """Whether the whole image is searched: while no hand is believed, and not each time if told."""
    if state.track is not None and not state.track.doubted:
        return False
    frames = model.detector.settings.search
    return frames == 1 or reached(state.search_age_s, frames)


def _first(found: Sequence[Detection]) -> Detection | None:
    return next(iter(found), None)


def _chosen(found: Sequence[Detection]) -> Detection | None:
    """The nearest of those hands that are seen about as well as the best one.

    Where nobody said which hand is meant, it is the one that is held out to the camera.
    """
    if not found:
        return None
    most = _AS_WELL * float(found[0].error_m[0])
    alike = [detection for detection in found if float(detection.error_m[0]) < most]
    return min(alike, key=lambda detection: float(detection.centre_m[2]), default=found[0])


def _sure(track: Track, settings: DetectorSettings, dt_s: float) -> bool:
    """Whether a track is believed so much that the networks need not look in this frame."""
    believed = track.log_odds is not None and track.log_odds > log_odds(settings.sure)
    due = reached(track.undetected_time_s + dt_s, settings.every)
    return believed and not due and track.challenged_s == 0


def _reachable(
    seen: LastSeen | None, track: Track | None, other: OtherHand | None, centre_m: np.ndarray
) -> float:
    """How likely a hand has come to a place from where it was last believed, log scale.

    Another hand, or the thing that hides the hand, is no place that it has jumped to.
    """
    if other is not None and np.linalg.norm(other.centre_m - centre_m) < SAME_PLACE_M:
        return -np.inf
    behind = None if track is None else track.expected
    if behind is not None and centre_m[2] < behind.nearest_m - _IN_FRONT_M:
        return -np.inf
    if seen is None:
        return 0.0
    particle = seen.particle.numpy()
    before = particle[0, :3] + pivot_offset(particle[:, 3:6])[0]
    away = float(np.linalg.norm(before - centre_m))
    off = away / (_STEP_M + _SPEED_M_S * seen.age_s)
    return -0.5 * off**2 if seen.age_s < _FORGOTTEN_S else 0.0


def expected_of(detection: Detection) -> Expected:
    """Where a hand is to be segmented that is not tracked yet."""
    joints = detection.joints_m[0]
    nearest, farthest = map(float, joints[:, 2].aminmax())
    return Expected(nearest, farthest, tuple(detection.centre_m.tolist()))


def keypoints_of(detection: Detection, model: TrackerModel) -> Keypoints:
    """The network's joints as the refinement takes them."""
    cfg, found = model.detector.settings, detection.keypoints
    sigma = (cfg.keypoint_sigmas * found.sigma_m).clamp(min=cfg.keypoint_m)
    return Keypoints(found.points_m, sigma / max(cfg.keypoint_weight, _NO_WEIGHT))


def hypotheses(detection: Detection, hand: SizedHand, count: int) -> tuple[Tensor, Tensor]:
    """The likeliest (H, 27) as states of a hand, and their log probabilities (H,)."""
    device = hand.shape.base_m.device
    ratio = hand.shape.hand_length_m / DEFAULT_HAND_LENGTH_M
    likely = int((detection.log_probability > np.log(_UNLIKELY)).sum())
    kept = detection.first(max(1, min(count, likely)))
    return kept.states(ratio).to(device), kept.log_probability.to(device)


def candidates(detection: Detection, frame: DetectedFrame, count: int) -> Tensor:
    """(H, 27) the networks' poses of the hand: the likeliest, and the likeliest bent to the votes.

    The votes are more exact than the hypotheses where a finger is seen, but no pose by themselves.
    """
    model = frame.model
    states, _ = hypotheses(detection, frame.hand, count)
    if not model.refinement.iterations:
        return states
    bent = states[:_BENT]
    nothing = SeenPoints(
        states.new_zeros(0, 3), states.new_zeros(0, 0, 2), frame.observation.k, (0, 0)
    )
    weight = max(model.detector.settings.keypoint_weight, _NO_WEIGHT)
    sigma = detection.keypoints.sigma_m.clamp(min=_BENT_M) / weight
    keypoints = Keypoints(detection.keypoints.points_m, sigma)
    freely = replace(model.refinement, angle_rad=_BENT_RAD, iterations=_BENT_STEPS)
    return torch.cat((frame.hand.refiner(bent, bent[:, 6:], nothing, freely, keypoints), states))


def joints_log_prior(joints_m: Tensor, frame: DetectedFrame) -> Tensor:
    """(N,) what speaks against joints (N, 21, 3) besides the image, beside log scores; at most 0.

    Fingers that are in one another or in another hand, and joints that are not where the networks'
    votes are.
    """
    model, detection = frame.model, frame.detection
    overlap, weight = model.refinement.overlap, model.detector.settings.keypoints
    keypoints = None if detection is None else keypoints_of(detection, model)
    length = frame.hand.shape.hand_length_m
    word = -model.backend.joints_penalty(joints_m, length, overlap, keypoints, weight)
    if frame.other is not None and frame.other.pixels is not None:
        word = word - _IN_OTHER * touching(joints_m, frame.other)
    return word


def log_posterior(
    states: Tensor, joints_m: Tensor, frame: DetectedFrame, coverage: float | None = None
) -> Tensor:
    """Log scores (N,) of hands (N, 27) with all that is known besides the image.

    joints_m: (N, 21, 3) of the hands.  coverage: as FMeasure.log_score has it. The word of the
    networks for a hand is that for the hypothesis which is most like it.
    """
    detector, detection = frame.model.detector, frame.detection
    assert detection is not None
    prior = frame.model.prior(frame.observation, frame.seen)
    away = joints_m[:, None] - detection.joints_m.to(joints_m.device)
    likest = away.norm(dim=-1).mean(-1).argmin(1)
    word = detection.log_probability.to(joints_m.device)[likest].clamp(min=_LEAST_LOG_PROBABILITY)
    word = detector.settings.prior * word + joints_log_prior(joints_m, frame)
    return frame.log_scores(states, coverage) + prior(states) + word


def begun(frame: DetectedFrame) -> Track:
    """A track that begins with the best of the networks' poses."""
    return track_of(best_start(frame)[0], frame.model)


def best_start(frame: DetectedFrame) -> tuple[Tensor, float]:
    """The best (1, 27) of the networks' poses, as they are and brought onto the seen points, and
    what is known of it, log scale.
    """
    model, detection = frame.model, frame.detection
    assert detection is not None
    states = candidates(detection, frame, model.detector.settings.hypotheses)
    if model.refinement.iterations:
        seen, keypoints = seen_points(frame.observation), keypoints_of(detection, model)
        better = frame.hand.refiner(states, states[:, 6:], seen, model.refinement, keypoints)
        states = torch.cat((states, better))
    scores = log_posterior(states, frame.hand.refiner.joints(states), frame, coverage=1.0)
    best = int(scores.argmax())
    return states[best][None], float(scores[best])


def track_of(pose: Tensor, model: TrackerModel) -> Track:
    """A track that begins with a pose (1, 27)."""
    particle, off = model.nearest(pose)
    n = model.filter.particles
    particles = on_device(particle, model.device).repeat(n, 1)
    weights = particles.new_full((n,), 1.0 / n, dtype=torch.float64)
    still = particle.new_zeros(particle.shape[1])
    return Track(particles, weights, particle, still, model.refinement.carry * off, pose)
