"""The hypotheses of a frame: proposed, brought onto the seen points, scored.

As in ICONDENSATION (Isard and Blake, ECCV 1998) with local optimisation (Gall et al., "Optimization
and filtering for human motion capture", IJCV 87, 2010): what the filter and the detector propose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.detector.hand_detector import Detection
from toftrack.detector.parts import FOREARM_PART, THING_PART
from toftrack.refinement.gauss_newton import Keypoints
from toftrack.refinement.seen_points import SeenPoints, seen_points
from toftrack.render.segmentation import Observation
from toftrack.tracking.confidence import out_of_sight
from toftrack.tracking.model import FilterModel, FittedHand, TrackerModel
from toftrack.tracking.posterior import (
    ImageTerm,
    KeypointsTerm,
    OtherHandTerm,
    OverlapTerm,
    Posterior,
    Term,
)
from toftrack.tracking.select import Hypotheses, Source
from toftrack.tracking.state import Track

_SURELY_PRESENT = 0.97
"""Probability of a hand from which on the network is believed which pixels are the hand's arm: a
chair's back was taken for a hand otherwise."""
_COVERED = 0.6
"""Share of the joints behind something from which on a hand is held where it was: it slips onto
what passes in front otherwise (a bottle: usable 94 instead of 44 % in one of six seeds)."""
_HIDDEN = 0.03
"""Share of the hand's pixels that must be hidden for it to matter."""
_UNLIKELY = 0.03
"""Hypotheses that are less probable are no candidates."""
_BENT_STEPS, _BENT_M, _BENT_RAD = 6, 0.010, 0.8
"""In how many steps a pose is bent to the keypoints; how sure the keypoints are at best, and how
far an angle may go."""
_NO_WEIGHT = 1e-6
"""Instead of 0, so that deviations stay numbers: kilometres."""
_LEAST_PARTS = 4
"""Parts of a crop, of 9 mm, that a thing in the hand has at least."""
_MOSTLY, _UNKNOWN = 0.5, 255
"""Of a surface in front of the hand, so much must be its arm where the network sees it; and the
class of what it does not see."""


@dataclass(frozen=True, eq=False)
class View:
    """A track's hand in one frame: what its poses are compared with.

    fitted: the hand as it is applied.  observation: not empty.
    expected_m: the depth at which its nearest joint was expected; 0 where the track begins.
    detection: what the pose network says of it; empty where it was not asked.
    others: (21, 3) each, joints of other hands.  image: the likelihood of the image.
    """

    track: Track
    fitted: FittedHand
    observation: Observation
    expected_m: float
    detection: Detection
    others: tuple[Tensor, ...]
    image: ImageTerm
    model: TrackerModel

    @cached_property
    def hidden(self) -> bool:
        """Whether something hides part of the hand."""
        hand, occluder = self.observation.hand.numpy(), self.observation.occluder.numpy()
        return int(np.count_nonzero(occluder)) > _HIDDEN * int(np.count_nonzero(hand))

    @property
    def covered(self) -> bool:
        """Whether so much of the hand is behind something that it is held where it was."""
        seen, joints = self.observation, self.fitted.refiner.joints(self.track.pose)[0]
        hiding_m = seen.depth_m * seen.occluder  # not another hand: the networks know both apart
        return out_of_sight(joints, hiding_m, seen.k)[1] > _COVERED

    @cached_property
    def keypoints(self) -> Keypoints:
        """The detection's, as the refinement takes them."""
        return keypoints_of(self.detection, self.model)

    @cached_property
    def seen(self) -> SeenPoints:
        """The points that poses are brought onto."""
        return seen_points(self.observation)

    def refined(self, poses: Tensor) -> Tensor:
        """Hands (N, 27) brought onto the seen points and the keypoints."""
        cfg = self.model.refinement
        return self.fitted.refiner(poses, poses[:, 6:], self.seen, cfg, self.keypoints)

    def posterior(self, keypoints: float | None = None) -> Posterior:
        """The posterior of the hand's pose.  keypoints: their weight, instead of its own."""
        weights, terms = self.model.weights, dict[str, Term]()
        keypoints = weights.keypoints if keypoints is None else keypoints
        if keypoints and not self.detection.empty:
            terms["keypoints"] = KeypointsTerm(self.keypoints, keypoints)
        if weights.overlap:
            terms["overlap"] = OverlapTerm(self.fitted.shape.hand_length_m, weights.overlap)
        if weights.other_hand:
            for number, joints in enumerate(self.others):
                terms[f"other hand {number}"] = OtherHandTerm(joints, weights.other_hand)
        return Posterior(self.image, self.fitted.refiner.joints, terms)


def with_parts(view: View) -> View:
    """The view with what the pose network says of its pixels: those of a thing in the hand are not
    the hand's, and where something hides the hand, those of its own arm do not.
    """
    seen = without_things(view.observation, view.detection)
    if view.hidden and view.detection.present >= _SURELY_PRESENT:
        seen = with_own_arm(seen, view.detection)
    if seen is view.observation:
        return view
    return replace(view, observation=seen, image=image_term(seen, view.fitted, view.model))


def image_term(
    observation: Observation,
    fitted: FittedHand,
    model: FilterModel,
    coverage: float | None = None,
) -> ImageTerm:
    """The likelihood of a segmented image, which is not empty."""
    evidence = model.likelihood.evidence(observation).to(model.device)
    return ImageTerm(model.likelihood, fitted.scorer, evidence, model.device, coverage)


def keypoints_of(detection: Detection, model: TrackerModel) -> Keypoints:
    """The detector's keypoints as the refinement takes them."""
    cfg, found = model.detector.settings, detection.keypoints
    sigma = found.sigma_m.clamp(min=cfg.keypoint_m)
    return Keypoints(found.points_m, sigma / max(cfg.keypoint_weight, _NO_WEIGHT))


def hypotheses_of(detection: Detection, fitted: FittedHand, count: int) -> Tensor:
    """(H, 27) the likeliest hypotheses as states of a hand; at least one, where there is any."""
    likely = int((detection.log_probability > math.log(_UNLIKELY)).sum())
    return detection.first(max(1, min(count, likely))).states(fitted.ratio)


def detector_poses(
    detection: Detection,
    observation: Observation,
    fitted: FittedHand,
    model: TrackerModel,
    count: int,
) -> Tensor:
    """(1 + H, 27) the detector's poses: the likeliest bent to the keypoints, and all as they are.

    The keypoints are more exact than the hypotheses where a finger is seen, but no pose by
    themselves. None where nothing was detected.
    """
    if detection.empty:
        return torch.zeros(0, 27)
    states = hypotheses_of(detection, fitted, count)
    if not model.refinement.iterations:
        return states
    bent = states[:1]
    nothing = SeenPoints(bent.new_zeros(0, 3), bent.new_zeros(0, 0, 2), observation.k, (0, 0))
    weight = max(model.detector.settings.keypoint_weight, _NO_WEIGHT)
    sigma = detection.keypoints.sigma_m.clamp(min=_BENT_M) / weight
    freely = replace(model.refinement, angle_rad=_BENT_RAD, iterations=_BENT_STEPS)
    keypoints = Keypoints(detection.keypoints.points_m, sigma)
    return torch.cat((fitted.refiner(bent, bent[:, 6:], nothing, freely, keypoints), states))


def best_start(view: View, keypoints: float | None = None) -> tuple[Tensor, float]:
    """The best (1, 27) of the detector's poses, as they are and refined, and its log posterior.

    keypoints: their weight in the posterior, instead of its own.
    """
    model = view.model
    count = model.detector.settings.hypotheses
    poses = detector_poses(view.detection, view.observation, view.fitted, model, count)
    if model.refinement.iterations:
        poses = torch.cat((poses, view.refined(poses)))
    values = view.posterior(keypoints)(poses)
    best = int(values.argmax())
    return poses[best][None], float(values[best])


def propose(view: View, mean: Tensor) -> Hypotheses:
    """The scored hypotheses of a frame's hand: the last frame's fingers where the filter has the
    hand, the filter's estimate (1, 27), and the detector's likeliest pose; refined.

    A hand that is mostly covered is held where it was. Poses that explain nothing of the image once
    they are refined stay as they were proposed: of a hand that leaves the image a few points are
    left, which may draw it anywhere.
    """
    model, posterior = view.model, view.posterior()
    if not model.refinement.iterations:
        return replace(Hypotheses.of(mean, Source.DYNAMICS), log_posterior=posterior(mean))
    if view.covered:
        held = Hypotheses.of(view.track.pose, Source.PREVIOUS)
        return replace(held, log_posterior=posterior(view.track.pose))
    detected = detector_poses(view.detection, view.observation, view.fitted, model, 1)
    previous = torch.cat((mean[:, :6], view.track.pose[:, 6:]), 1)
    tables = [
        Hypotheses.of(previous, Source.PREVIOUS),
        Hypotheses.of(mean, Source.DYNAMICS),
        Hypotheses.of(detected, Source.DETECTOR),
    ]
    table = Hypotheses.joined(tables)
    pose = view.refined(table.pose)
    values = posterior(pose)
    pose = torch.where(values.isneginf()[:, None], table.pose, pose)
    return replace(table, pose=pose, log_posterior=values)


def without_things(observation: Observation, detection: Detection) -> Observation:
    """The same without the pixels of a thing in the hand, as the pose network tells them.

    Else the best pose is one whose fingers explain the thing.
    """
    kind = detection.parts.kind
    if observation.empty or np.count_nonzero(kind == THING_PART) < _LEAST_PARTS:
        return observation
    thing = _pixels_of(observation.hand, observation, detection, THING_PART)
    return replace(observation, hand=observation.hand & ~thing, thing=thing)


def with_own_arm(observation: Observation, detection: Detection) -> Observation:
    """The same with what the pose network calls the hand's forearm told from what hides it.

    Who wears the camera has the arm nearer to it than the hand, which it does not hide as what
    passes in front does. A surface in front is the arm when the network says so of most of it.
    """
    occluder = observation.occluder.cpu().numpy()
    count, surface = cv2.connectedComponents(occluder.astype(np.uint8), connectivity=4)
    row, column = np.nonzero(occluder)
    kind = detection.parts.at(_points_of(row, column, observation), outside=_UNKNOWN)
    of = surface[row, column]
    known = np.bincount(of[kind != _UNKNOWN], minlength=count)
    mine = np.bincount(of[kind == FOREARM_PART], minlength=count)
    arm = torch.from_numpy((mine > _MOSTLY * known)[surface] & occluder).to(observation.hand.device)
    return replace(observation, hand=observation.hand | arm, occluder=observation.occluder & ~arm)


def _pixels_of(
    among: Tensor, observation: Observation, detection: Detection, *kinds: int
) -> Tensor:
    """(H, W) bool: those pixels of a mask that the pose network says are of some classes."""
    row, column = np.nonzero(among.cpu().numpy())
    chosen = np.isin(detection.parts.at(_points_of(row, column, observation)), kinds)
    mask = np.zeros(among.shape, bool)
    mask[row[chosen], column[chosen]] = True
    return torch.from_numpy(mask).to(among.device)


def _points_of(row: np.ndarray, column: np.ndarray, observation: Observation) -> np.ndarray:
    """(P, 3) what is seen at pixels, camera frame."""
    k, z = observation.k.cpu().numpy(), observation.depth_m.cpu().numpy()[row, column]
    x, y = (column - k[0, 2]) / k[0, 0] * z, (row - k[1, 2]) / k[1, 1] * z
    return np.stack((x, y, z), 1)
