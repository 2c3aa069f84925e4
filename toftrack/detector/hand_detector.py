"""The detector as the tracker uses it: where hands are, and what they look like there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from toftrack.compute.threads import beside, run_shared
from toftrack.compute.transfer import on_device, on_host
from toftrack.detector.crops import wide
from toftrack.detector.decoding_numba import decode_at
from toftrack.detector.detection import Detection
from toftrack.detector.network import Finder, Found, PoseNet
from toftrack.detector.onnx_networks import OnnxFinder, OnnxPoseNet, load_networks
from toftrack.detector.proposals import Crop, Places, likely_places
from toftrack.errors import check_number

_AGAIN = 3.0
"""A place is looked at again if its merit is less than what a hand needs by no more than this: the
second look is more exact."""


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
        """What the pose network says of a hand of a side at each of C places (C, 3), in order.

        depth_m: (H, W) rectified Z in metres, 0 = no reading.  k: (3, 3).
        up: (C, 3) where the fingers point, as far as that is known, which is up in the crops, see
            crops.crop_rotation; None: crops as the camera is held. The network knows hands better
            that are upright, more or less.
        """
        count, found = len(centres_m), dict[int, Detection]()
        rows = iter(range(count))

        def look() -> None:
            """At the next place as long as there is one, which other threads may have taken.

            At each by itself: a batch takes as long, and what is said of a crop would depend on
            others.
            """
            for row in rows:
                crop = Crop(depth_m, k, centres_m[row], side, None if up is None else up[row])
                found[row] = crop.decode(self.pose.outputs(crop.image))

        run_shared(look, count if self._may_be_shared else 1)
        return [found[row] for row in range(count)]

    def start(
        self,
        depth_m: np.ndarray,
        k: np.ndarray,
        centre_m: np.ndarray,
        side: str,
        up: np.ndarray | None = None,
    ) -> Callable[[], Detection]:
        """The same at one place (3,), `up` (3,), begun in another thread if there may be one; what
        is returned waits for it.

        That thread has nothing to do but the network, so that it hardly needs the interpreter's
        lock.
        """
        crop = Crop(depth_m, k, centre_m, side, up)
        look = partial(self.pose.outputs, crop.image)
        wait = beside(look) if self._may_be_shared else look
        return lambda: crop.decode(wait())

    @property
    def _may_be_shared(self) -> bool:
        """Whether other threads may run the pose network: torch has threads of its own, and needs
        the lock.
        """
        return isinstance(self.pose, OnnxPoseNet) and decode_at.is_compiled

    def look(
        self, depth_m: np.ndarray, k: np.ndarray, places: Places, side: str
    ) -> list[Detection]:
        """Hands of a side at places of the finder, that of the largest merit first; those without
        the least `merit` of the settings are left out.

        At the better places poses are proposed twice, the second time about the palm that was found
        with its fingers upright: they are the more exact the nearer the crop's centre is to the
        middle of the palm.
        """
        least = self.settings.merit
        first = self.detect(depth_m, k, places.centre_m, side)
        both = zip(first, places.probability.tolist(), strict=True)
        seen = [replace(one, heat=heat) for one, heat in both]
        good = [one for one in seen if one.merit > least - _AGAIN]
        palms = np.array([one.centre_m.numpy() for one in good]).reshape(-1, 3)
        up = np.array([one.up for one in good]).reshape(-1, 3)
        again = zip(self.detect(depth_m, k, palms, side, up), good, strict=True)
        found = [replace(one, heat=before.heat) for one, before in again]
        return sorted((one for one in found if one.merit > least), key=lambda one: -one.merit)

    def start_search(
        self, depth_m: np.ndarray, k: np.ndarray, known: int = 0
    ) -> Callable[[], Places]:
        """The likeliest places of hands of either side, by the finder; begun in another thread if
        there may be one; what is returned waits for it.

        known: how many hands are followed: the finder sees them, too, so that so many more places
            are returned.
        """
        image, wide_k = wide(depth_m, k)

        @torch.inference_mode()
        def look() -> Found:
            return Found(*on_host(*self.finder(on_device(image, self.finder.device))))

        wait = beside(look) if isinstance(self.finder, OnnxFinder) else look
        most, least = self.settings.places + known, self.settings.least
        return lambda: likely_places(wait(), wide_k, most, least)


def make_detector(weights: str | None = None, **settings: Any) -> HandDetector:
    """The detector of a configuration.

    weights: a file of `toftrack.training`; None = the package's.
    Raises ToftrackError when they cannot be used.
    """
    return HandDetector(*load_networks(weights), DetectorSettings(**settings))


def no_detector() -> None:
    """detector=none: the paper's tracker."""
