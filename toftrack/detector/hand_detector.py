"""The detector as the tracker uses it: where hands are, and what they look like there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.rigid import pivot_offset
from toftrack.detector.network import Finder, PoseNet
from toftrack.detector.onnx_networks import OnnxFinder, OnnxPoseNet, load_networks
from toftrack.detector.parts import ALL_HAND, Parts
from toftrack.detector.proposals import (
    NetworkOutput,
    Places,
    run_pose_network,
    start_finding,
    start_pose_network,
)
from toftrack.errors import check_number
from toftrack.hand.overlap import overlap_of_each
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M
from toftrack.refinement.gauss_newton import Keypoints

_AGAIN = 3.0
"""The first look may be so much worse than what a hand needs: the second one is more exact."""
_DOUBT_M = 0.06
"""How far off a finger's outer joints may be that lies in another one, by the keypoints."""
_OUTER = np.array([0, 1, 1, 1], np.float32)
"""Of a finger's joints, those that may be another one's."""
_CLEAR_M = 0.010
"""Expected error that counts as much as a factor e in probability."""

_OF_HYPOTHESES = "pivot_m rotvec angles joints_m log_size log_probability error_m".split()
"""Fields of a Detection that have a row for each hypothesis."""


@dataclass(frozen=True)
class DetectorSettings:
    """How the networks are used; see conf/detector/network.yaml for what each does."""

    places: int
    least: float
    merit: float
    hypotheses: int
    every: int
    search: int
    sure: float
    flying: float
    keypoint_m: float
    keypoint_weight: float

    def __post_init__(self) -> None:
        for name in ("places", "hypotheses", "every", "search"):
            check_number(f"detector.{name}", getattr(self, name), 1, whole=True)
        check_number("detector.sure", self.sure, 0.5, 0.999)
        check_number("detector.least", self.least, 0, 1)
        check_number("detector.merit", self.merit)
        check_number("detector.flying", self.flying, 0)
        check_number("detector.keypoint_weight", self.keypoint_weight, 0)
        check_number("detector.keypoint_m", self.keypoint_m, 0, above=True)


@dataclass(frozen=True, eq=False)
class Detection:
    """What the pose network says of the hand at one place, likeliest hypothesis first.

    pivot_m, rotvec, angles: (H, 3), (H, 3), (H, 21).  joints_m: (H, 21, 3) of a hand of that size.
    log_size: (H,) of the hand's length in units of the mean adult's.
    log_probability, error_m: (H,).
    keypoints: the joints, each with its standard deviation.
    present, right_side: probabilities that there is a hand, and that it is of the side looked for.
    parts: which of the pixels are the hand, and which a thing's that it holds.
    heat, merit: of a place of a search, the finder's probability, and how much speaks for a hand
        there with all that is known, log scale.
    """

    pivot_m: Tensor
    rotvec: Tensor
    angles: Tensor
    joints_m: Tensor
    log_size: Tensor
    log_probability: Tensor
    error_m: Tensor
    keypoints: Keypoints
    present: float
    right_side: float
    parts: Parts = ALL_HAND
    heat: float = 1.0
    merit: float = math.inf

    def states(self, ratio: float, count: int | None = None) -> Tensor:
        """(H, 27) as states of a hand whose length is `ratio` mean adult's: same palm's middle.

        count: of so many hypotheses at most; None = all.
        """
        pivot, rotvec = self.pivot_m.numpy()[:count], self.rotvec.numpy()[:count]
        states = np.empty((len(rotvec), 27), np.float32)
        states[:, 3:6], states[:, 6:] = rotvec, self.angles.numpy()[:count]
        states[:, :3] = pivot - np.float32(ratio) * pivot_offset(rotvec)
        return torch.from_numpy(states)

    @property
    def empty(self) -> bool:
        """Whether nothing was said; see NO_DETECTION."""
        return not len(self.rotvec)

    @property
    def length_m(self) -> float:
        """The hand's length, the mean of the hypotheses'."""
        weights = self.log_probability.softmax(0)
        return DEFAULT_HAND_LENGTH_M * float((weights * self.log_size).sum().exp())

    @property
    def centre_m(self) -> Tensor:
        """(3,) middle of the palm of the likeliest hypothesis."""
        return self.pivot_m[0]

    @property
    def up(self) -> np.ndarray:
        """(3,) where its fingers point: from the wrist to the middle finger's knuckle."""
        wrist, knuckle = self.keypoints.points_m[[0, 9]].numpy()
        return np.asarray(knuckle - wrist)


NO_DETECTION = Detection(
    pivot_m=torch.zeros(0, 3),
    rotvec=torch.zeros(0, 3),
    angles=torch.zeros(0, 21),
    joints_m=torch.zeros(0, 21, 3),
    log_size=torch.zeros(0),
    log_probability=torch.zeros(0),
    error_m=torch.zeros(0),
    keypoints=Keypoints(torch.zeros(21, 3), torch.full((21,), torch.inf)),
    present=0.0,
    right_side=0.5,
)
"""Of a frame in which the network was not asked, or found no hand."""


@dataclass(frozen=True, eq=False)
class HandDetector:
    """Both networks and how they are used; images are read, and answers given, on the CPU."""

    pose: PoseNet | OnnxPoseNet
    finder: Finder | OnnxFinder
    settings: DetectorSettings

    def to(self, device: torch.device) -> HandDetector:
        """The same with the networks on a device, where they are moved."""
        return replace(self, pose=self.pose.to(device), finder=self.finder.to(device))

    def detect(
        self,
        depth_m: np.ndarray,
        k: np.ndarray,
        centres_m: np.ndarray,
        side: str,
        up: np.ndarray | None = None,
    ) -> list[Detection]:
        """What a hand of a side is like at each of C places (C, 3), in their order.

        depth_m: (H, W) rectified Z, 0 = no reading.  k: (3, 3).
        up: (C, 3) where its fingers point, see proposals.run_pose_network; None = unknown.
        """
        if len(centres_m) == 0:
            return []
        seen = run_pose_network(self.pose, depth_m, k, centres_m, side, up)
        return [_detection(seen, row) for row in range(len(seen.present))]

    def start(
        self,
        depth_m: np.ndarray,
        k: np.ndarray,
        centre_m: np.ndarray,
        side: str,
        up: np.ndarray | None = None,
    ) -> Callable[[], Detection]:
        """The same at one place (3,), begun beside whatever does not need it."""
        wait = start_pose_network(self.pose, depth_m, k, centre_m, side, up)
        return lambda: _detection(wait(), 0)

    def look(
        self, depth_m: np.ndarray, k: np.ndarray, places: Places, side: str
    ) -> list[Detection]:
        """Hands of a side at places of the finder, the best first; those that may be none are left
        out, by the `merit` of the settings.

        At the better places poses are proposed twice, the second time about the palm that was found
        with its fingers upright: they are the more exact the nearer the crop's centre is to the
        middle of the palm.
        """
        least = self.settings.merit
        first = self.detect(depth_m, k, places.centre_m, side)
        both = zip(first, places.probability, strict=True)
        good = [(one, float(heat)) for one, heat in both if merit(one, heat) > least - _AGAIN]
        again = np.array([one.centre_m.numpy() for one, _ in good]).reshape(-1, 3)
        up = np.array([one.up for one, _ in good]).reshape(-1, 3)
        found = [
            replace(one, heat=heat, merit=merit(one, heat))
            for one, (_, heat) in zip(self.detect(depth_m, k, again, side, up), good, strict=True)
        ]
        return sorted((one for one in found if one.merit > least), key=lambda one: -one.merit)

    def start_search(
        self, depth_m: np.ndarray, k: np.ndarray, known: int = 0
    ) -> Callable[[], Places]:
        """Where hands may be, the first part of a search; begun beside whatever can do without.

        known: so many hands are, which are among these places.
        """
        cfg = self.settings
        return start_finding(self.finder, depth_m, k, cfg.places + known, cfg.least)


def merit(detection: Detection, heat: float) -> float:
    """How much speaks for a hand of the side that is looked for at a place, log scale.

    heat: the finder's probability.
    """
    odds = math.log(max(heat, 1e-6)) + math.log(max(detection.present, 1e-6))
    odds += 0.5 * math.log(max(detection.right_side, 1e-3))
    return odds - doubt_m(detection) / _CLEAR_M


def doubt_m(detection: Detection) -> float:
    """How far off the pose network takes itself to be, metres."""
    return float(detection.error_m[0]) + 0.5 * float(detection.keypoints.sigma_m.mean())


def _detection(seen: NetworkOutput, row: int) -> Detection:
    points_m = seen.keypoints_m[row]
    length_m = DEFAULT_HAND_LENGTH_M * math.exp(float(seen.log_size[row, 0]))
    return Detection(
        **{name: getattr(seen, name)[row] for name in _OF_HYPOTHESES},
        keypoints=Keypoints(points_m, doubted_sigma_m(points_m, seen.sigma_m[row], length_m)),
        present=float(seen.present[row].sigmoid()),
        right_side=float(seen.right[row].sigmoid()),
        parts=seen.parts[row],
    )


def doubted_sigma_m(points_m: Tensor, sigma_m: Tensor, hand_length_m: float) -> Tensor:
    """(21,) deviations of keypoints (21, 3): larger where those of two fingers coincide.

    Of a single finger that is seen the cells do not know which one it is, and say surely that it is
    either; what is no hand, such as an elbow, has its fingers in one another.
    """
    # In numpy: on a few numbers each of torch's operations takes longer than its arithmetic.
    overlap = overlap_of_each(points_m[None], hand_length_m)[0].numpy()
    doubt_m = _DOUBT_M * np.minimum(overlap, 1)[:, None] * _OUTER
    sigma = sigma_m.numpy().copy()
    sigma[1:] = np.hypot(sigma[1:], doubt_m.ravel())
    return torch.from_numpy(sigma)


def make_detector(weights: str | None = None, **settings: Any) -> HandDetector:
    """The detector of a configuration.

    weights: a file of `toftrack.training`; None = the package's.
    Raises ToftrackError when they cannot be used.
    """
    return HandDetector(*load_networks(weights), DetectorSettings(**settings))


def no_detector() -> None:
    """detector=none: the paper's tracker."""
