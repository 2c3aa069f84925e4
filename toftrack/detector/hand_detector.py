"""The detector as the tracker uses it: where hands are, and what they look like there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from toftrack.detector.detection import Detection, merit
from toftrack.detector.network import Finder, PoseNet
from toftrack.detector.onnx_networks import OnnxFinder, OnnxPoseNet, load_networks
from toftrack.detector.proposals import (
    Places,
    run_pose_network,
    start_finding,
    start_pose_network,
)
from toftrack.errors import check_number

_AGAIN = 3.0
"""The first look may be so much worse than what a hand needs: the second one is more exact."""


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
        return run_pose_network(self.pose, depth_m, k, centres_m, side, up)

    def start(
        self,
        depth_m: np.ndarray,
        k: np.ndarray,
        centre_m: np.ndarray,
        side: str,
        up: np.ndarray | None = None,
    ) -> Callable[[], Detection]:
        """The same at one place (3,), begun beside whatever does not need it."""
        return start_pose_network(self.pose, depth_m, k, centre_m, side, up)

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

        known: hands that are followed: the finder sees them, too, so that so many more places are
            given.
        """
        cfg = self.settings
        return start_finding(self.finder, depth_m, k, cfg.places + known, cfg.least)


def make_detector(weights: str | None = None, **settings: Any) -> HandDetector:
    """The detector of a configuration.

    weights: a file of `toftrack.training`; None = the package's.
    Raises ToftrackError when they cannot be used.
    """
    return HandDetector(*load_networks(weights), DetectorSettings(**settings))


def no_detector() -> None:
    """detector=none: the paper's tracker."""
