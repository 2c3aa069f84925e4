"""The hypotheses of a frame: proposed by the filter and the detector, refined, scored, selected.

Data-driven proposals are as in ICONDENSATION (Isard and Blake, ECCV 1998), local optimisation as in
Gall et al., "Optimization and filtering for human motion capture" (IJCV 87, 2010).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.detector.detection import Detection
from toftrack.detector.parts import FOREARM_PART, THING_PART, UNKNOWN_PART, Parts
from toftrack.hand.overlap import finger_overlap
from toftrack.refinement.gauss_newton import Keypoints, Refinement
from toftrack.refinement.seen_points import SeenPoints, seen_points
from toftrack.render.segmentation import Observation
from toftrack.tracking.confidence import out_of_sight
from toftrack.tracking.model import FittedHand, TrackerModel
from toftrack.tracking.posterior import ImageTerm, PosteriorWeights, keypoints_off, touching
from toftrack.tracking.state import Track

_SURELY_PRESENT = 0.97
"""From this probability of a hand on, the network tells the arm's pixels: else a chair's back was
taken for a hand."""
_COVERED = 0.6
"""A hand with more than this share of its joints behind something keeps its pose: it slips onto
what passes in front otherwise (a bottle: usable 94 instead of 44 % in one of six seeds)."""
_HIDDEN = 0.03
"""A hand is hidden when its occluder has more than this share of the pixels that it has."""
_UNLIKELY = 0.03
"""Hypotheses that are less probable are no candidates."""
_BENT_STEPS, _BENT_M, _BENT_RAD = 6, 0.010, 0.8
"""Where a pose is bent to the keypoints: Gauss-Newton steps; the least standard deviation of a
keypoint; and the standard deviation of an angle about the pose."""
_LEAST_PARTS = 4
"""A thing in the hand covers at least so many of the crop's parts, which are 9 mm wide."""
_MOSTLY = 0.5
"""A surface in front is the hand's arm when more than this share of it is, where the network sees
it."""
_MARGIN = 0.05
"""By how much the log posterior of a pose of the detector must exceed that of the other poses:
neighbouring fingers change places from frame to frame otherwise (swaps +0.6 points)."""
_SURE_LEAD = 2.0
"""The same where the pose is elsewhere and something hides the hand: without it, a second hand that
crosses the first one is silently wrong in 5 % of the frames."""
_ELSEWHERE_M = 0.02
"""A pose of the detector is elsewhere when its joints are on average so far from those of the best
other pose."""
WORST = -1e6
"""Log posterior that replaces the -inf of a pose that explains nothing, so that differences of log
posteriors are finite."""


@dataclass(frozen=True, eq=False)
class View:
    """A track's hand in one frame, and what its poses are compared with.

    fitted: the hand in the applied shape.  observation: not empty.
    expected_m: the depth of its nearest joint, as predicted, or as detected where it (re)starts.
    detection: empty where the pose network did not look.
    others: joints (21, 3) m of each other hand.
    weights: of the posterior's terms.  coverage: see ImageTerm.
    """

    track: Track
    fitted: FittedHand
    observation: Observation
    expected_m: float
    detection: Detection
    others: tuple[Tensor, ...]
    model: TrackerModel
    weights: PosteriorWeights
    coverage: float | None = None

    @cached_property
    def image(self) -> ImageTerm:
        """The likelihood of the image."""
        return ImageTerm(self.model, self.observation, self.fitted.scorer, self.coverage)

    @cached_property
    def hidden(self) -> bool:
        """Whether something hides part of the hand."""
        seen = self.observation
        hand, occluder = (np.count_nonzero(mask.numpy()) for mask in (seen.hand, seen.occluder))
        return bool(occluder > _HIDDEN * hand)

    @property
    def covered(self) -> bool:
        """Whether so much of the hand's last pose is behind something that the pose is kept."""
        if not self.hidden:
            return False
        seen, joints = self.observation, self.fitted.refiner.joints(self.track.pose)[0]
        hiding_m = seen.depth_m * seen.occluder  # not another hand: the networks know both apart
        hidden: float = out_of_sight(joints.numpy(), hiding_m.numpy(), seen.k.double().numpy())[1]
        return hidden > _COVERED

    @cached_property
    def keypoints(self) -> Keypoints:
        """The detection's keypoints, with the configured least deviation."""
        return self.keypoints_within(self.model.detector.settings.keypoint_m)

    def keypoints_within(self, least_m: float) -> Keypoints:
        """The detection's keypoints, with the configured weight and a least deviation."""
        found, weight = self.detection.keypoints, self.model.detector.settings.keypoint_weight
        return Keypoints(found.points_m, found.sigma_m.clamp(min=least_m) / max(weight, 1e-6))

    @cached_property
    def seen(self) -> SeenPoints:
        """The points of the image that poses are refined onto."""
        return seen_points(self.observation)

    def refine(self, poses: Tensor) -> Tensor:
        """(N, 27) poses (N, 27), refined onto the seen points and the keypoints."""
        cfg = self.model.refinement
        return self.fitted.refiner(poses, poses[:, 6:], self.seen, cfg, self.keypoints)

    def log_posterior(self, poses: Tensor) -> Tensor:
        """(N,) log posteriors of poses (N, 27), see posterior.py."""
        weights, total = self.weights, self.image(poses)
        joints = self.fitted.refiner.joints(poses)
        if weights.keypoints and not self.detection.empty:
            total = total - weights.keypoints * keypoints_off(joints, self.keypoints)
        if weights.overlap:
            length_m = self.fitted.shape.hand_length_m
            total = total - weights.overlap * finger_overlap(joints, length_m)
        if weights.other_hand:
            for other_m in self.others:
                total = total - weights.other_hand * touching(joints, other_m)
        return total


def with_parts(view: View) -> View:
    """The view with its pixels told apart by the pose network: those of a thing in the hand no
    longer count as the hand's; where the hand is hidden, those of its own arm count as the hand's
    instead of its occluder's.

    Without a detection, the network's last look at the track tells the thing's pixels: in the hand
    it hardly moves from frame to frame.
    """
    detection = view.detection
    parts = view.track.parts if detection.empty else detection.parts
    seen = without_things(view.observation, parts)
    if detection.present >= _SURELY_PRESENT and view.hidden:
        seen = with_own_arm(seen, detection)
    return view if seen is view.observation else replace(view, observation=seen)


def hypotheses_of(detection: Detection, fitted: FittedHand, count: int) -> Tensor:
    """(H, 27) the likely hypotheses, `count` at most, as poses of a hand; the best one at least."""
    likely = int((detection.log_probability.numpy() > math.log(_UNLIKELY)).sum())
    return detection.states(fitted.ratio, max(1, min(count, likely)))


def bent_pose(view: View) -> Tensor:
    """(1, 27) a detection's likeliest pose, bent to the keypoints; (0, 27) without a detection.

    Keypoints are more exact than hypotheses where a finger is seen, but no pose by themselves.
    """
    if view.detection.empty:
        return torch.zeros(0, 27)
    pose = view.detection.states(view.fitted.ratio, 1)
    silhouette = pose.new_zeros(0, 0, dtype=torch.int32)
    nothing = SeenPoints(pose.new_zeros(0, 3), silhouette, view.observation.k, (0, 0))
    settings = _bending(view.model.refinement)
    keypoints = view.keypoints_within(_BENT_M)
    return view.fitted.refiner(pose, pose[:, 6:], nothing, settings, keypoints)


@lru_cache
def _bending(settings: Refinement) -> Refinement:
    """The settings of the refinement that bends a pose to keypoints."""
    return replace(settings, angle_rad=_BENT_RAD, iterations=_BENT_STEPS)


def best_start(view: View) -> tuple[Tensor, float]:
    """The best (1, 27) of the detection's poses, raw or refined, and its log posterior.

    view: with a detection.
    """
    model = view.model
    poses = hypotheses_of(view.detection, view.fitted, model.detector.settings.hypotheses)
    if model.refinement.iterations:
        poses = torch.cat((bent_pose(view), poses))
        poses = torch.cat((poses, view.refine(poses)))
    values = view.log_posterior(poses)
    best = int(values.argmax())
    return poses[best][None], float(values[best])


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """N poses of one hand, each with its log posterior.

    pose: (N, 27).  log_posterior: (N,).
    detected: (N,) bool, whether the pose comes from the detector.
    """

    pose: Tensor
    detected: np.ndarray
    log_posterior: Tensor


def propose(view: View, mean: Tensor) -> Hypotheses:
    """The refined and scored hypotheses of a frame: the filter's `mean` (1, 27), its wrist with the
    last frame's fingers, and the detector's likeliest pose, bent to the keypoints.

    A covered hand has its last pose alone; without refinement there is `mean` alone. A pose that
    explains nothing once refined stays as proposed: the few points that are left of a hand that
    leaves the image may draw it anywhere.
    """
    if not view.model.refinement.iterations:
        return scored(view, mean)
    if view.covered:
        return scored(view, view.track.pose)
    detected = bent_pose(view)
    previous = torch.cat((mean[:, :6], view.track.pose[:, 6:]), 1)
    poses = torch.cat((previous, mean, detected))
    table = scored(view, view.refine(poses), len(detected))
    nothing = table.log_posterior.isneginf()[:, None]
    return replace(table, pose=torch.where(nothing, poses, table.pose))


def scored(view: View, poses: Tensor, detected: int = 0) -> Hypotheses:
    """Poses (N, 27) with their log posteriors; the last `detected` ones are the detector's."""
    detectors = np.arange(len(poses)) >= len(poses) - detected
    return Hypotheses(poses, detectors, view.log_posterior(poses))


def select(table: Hypotheses, joints_m: Tensor, hidden: bool) -> tuple[Tensor, bool]:
    """The pose (1, 27) that becomes a frame's estimate, and whether the track restarts there.

    It has the best posterior, where the detector's pose must be better by a margin. The track
    restarts where it is a pose of the detector elsewhere than the others.

    table: with at least one pose that is not the detector's.  joints_m: (N, 21, 3) of its poses.
    hidden: something hides part of the hand. Then a pose elsewhere needs a large lead, for it may
        be the pose of what hides the hand, such as another hand.
    """
    # In numpy: on a few rows each of torch's operations takes longer than its arithmetic.
    joints, detected = joints_m.numpy(), table.detected
    values = np.maximum(table.log_posterior.numpy(), WORST)
    base = int(np.where(detected, -np.inf, values).argmax())
    away = np.sqrt(np.square(joints - joints[base]).sum(-1)).mean(1)
    elsewhere = detected & (away >= _ELSEWHERE_M)
    values = values - np.where(elsewhere & hidden, _SURE_LEAD, _MARGIN * detected)
    best = int(values.argmax())
    return table.pose[best][None], bool(elsewhere[best])


def without_things(observation: Observation, parts: Parts) -> Observation:
    """The observation without the pixels that the pose network calls a thing in the hand.

    Else the best pose is one whose fingers explain the thing.
    """
    if np.count_nonzero(parts.kind == THING_PART) < _LEAST_PARTS:
        return observation
    thing = _classes(observation, observation.hand, parts) == THING_PART
    if not thing.any():
        return observation
    of_thing = torch.from_numpy(thing)
    return replace(observation, hand=observation.hand & ~of_thing, thing=of_thing)


def with_own_arm(observation: Observation, detection: Detection) -> Observation:
    """The observation with the hand's forearm moved from its occluders to the hand.

    Who wears the camera has the arm nearer to it than the hand, which it does not hide. A surface
    in front is the arm when the pose network calls most of it a forearm.
    """
    occluder = observation.occluder.numpy()
    count, surface = cv2.connectedComponents(occluder.astype(np.uint8), connectivity=4)
    kind = _classes(observation, observation.occluder, detection.parts)
    known = np.bincount(surface[kind != UNKNOWN_PART], minlength=count)
    mine = np.bincount(surface[kind == FOREARM_PART], minlength=count)
    of_arm = (mine > _MOSTLY * known)[surface] & occluder
    if not of_arm.any():
        return observation
    arm = torch.from_numpy(of_arm)
    return replace(observation, hand=observation.hand | arm, occluder=observation.occluder & ~arm)


def _classes(observation: Observation, pixels: Tensor, parts: Parts) -> np.ndarray:
    """(H, W) the classes of some `pixels` (H, W) of an observation, see Parts.seen."""
    return parts.seen(observation.depth_m.numpy(), pixels.numpy(), observation.k.numpy())
