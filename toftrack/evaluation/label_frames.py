"""The frames that somebody labels, with where the hand is in them, and what the tracker says."""

from __future__ import annotations

import sys
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from hydra.utils import instantiate
from omegaconf import DictConfig
from tqdm import tqdm

from toftrack.api import build_tracker
from toftrack.compute.threads import small_operations
from toftrack.configuration.compose import one_sentence
from toftrack.detector.hand_detector import HandDetector
from toftrack.devices.base import Device
from toftrack.errors import ToftrackError
from toftrack.estimate import Estimate

_AROUND = 1.7
"""How much more than the hand is shown."""
_BEFORE_M, _BEHIND_M = 0.03, 0.05
"""Of the depths that contrast is given to, beside those of the hand's joints."""


@dataclass(frozen=True, eq=False)
class LabelFrame:
    """A frame as it is shown.

    depth_mm: (H, W) uint16 Z, undistorted, 0 = no reading.
    centre_px, reach_px: what to show first: so far about (u, v).
    near_mm, far_mm: the depths that contrast is given to.
    estimate_px: (21, 2) the tracker's joints; None where it was not asked, or lost the hand.
    """

    number: int
    depth_mm: np.ndarray
    centre_px: tuple[float, float]
    reach_px: float
    near_mm: float
    far_mm: float
    estimate_px: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Tracked:
    """What the tracker says of every frame.

    estimates: (T,).
    confidence: (T,), 0 where the hand is lost; 1 where nobody finds one, so that such come last.
    """

    estimates: tuple[Estimate, ...]
    confidence: np.ndarray


def track(device: Device, config: DictConfig) -> Tracked:
    """Track all of a recording, with a configuration of one hand. Raises ToftrackError."""
    with one_sentence():
        tracker, detector = build_tracker(config), instantiate(config.detector)
    camera, estimates, confidence = device.camera, [], []
    for frame in tqdm(device, total=device.frames, unit=" frames", file=sys.stderr):
        depth_m = camera.rectify(frame.depth, frame.radial)
        estimate = tracker.step(depth_m, camera.K, frame.index, frame.timestamp_s)
        estimates.append(estimate)
        if not estimate.lost:
            confidence.append(float(np.nan_to_num(estimate.confidence)))
        else:
            nobody = detector is not None and _found(detector, depth_m, camera.K) is None
            confidence.append(float(nobody))
    return Tracked(tuple(estimates), np.array(confidence))


def label_frames(
    device: Device,
    config: DictConfig,
    numbers: Collection[int],
    known: Tracked | None = None,
) -> list[LabelFrame]:
    """The frames of these numbers, rising, ready to be shown.

    known: what the tracker says; None = it was not asked.

    Raises ToftrackError when the device's frames are not those of a whole recording.
    """
    with one_sentence():
        detector = instantiate(config.detector)
    camera, shown = device.camera, []
    for row, frame in enumerate(device):
        if frame.index != row:
            raise ToftrackError(
                "the tracker is measured on whole recordings; leave out device.start and the like"
            )
        if row in numbers:
            depth_m = camera.rectify(frame.depth, frame.radial)
            estimate = None if known is None or known.estimates[row].lost else known.estimates[row]
            joints_m = (
                _found(detector, depth_m, camera.K) if estimate is None else estimate.joints_m
            )
            shown.append(
                LabelFrame(
                    row,
                    np.clip(1e3 * depth_m + 0.5, 0, 65535).astype("<u2"),
                    *_about(joints_m, depth_m, camera.K),
                    None if estimate is None else _projected(estimate.joints_m, camera.K),
                )
            )
        if len(shown) == len(numbers):
            break
    return shown


def _found(detector: HandDetector | None, depth_m: np.ndarray, k: np.ndarray) -> np.ndarray | None:
    """(21, 3) m, roughly, of the likeliest hand in an image; None where none is found."""
    if detector is None:  # the paper's tracker has none
        return None
    with small_operations():
        depth_m = np.require(depth_m, np.float32, ("C", "W"))
        places = detector.start_search(depth_m, k)()
        seen = [
            one for side in ("right", "left") for one in detector.look(depth_m, k, places, side)
        ]
    best = max(seen, key=lambda one: one.merit, default=None)
    return None if best is None else best.keypoints.points_m.numpy()


def _about(
    joints_m: np.ndarray | None, depth_m: np.ndarray, k: np.ndarray
) -> tuple[tuple[float, float], float, float, float]:
    """Centre, reach, near and far of what is shown: the whole image where no hand is known."""
    height, width = depth_m.shape
    if joints_m is None or not np.isfinite(joints_m).all() or joints_m[:, 2].min() <= 0:
        seen = depth_m[depth_m > 0]
        near, far = np.percentile(seen, (1, 50)) if seen.size else (0.2, 1.0)
        return ((width - 1) / 2, (height - 1) / 2), max(width, height) / 2, 1e3 * near, 1e3 * far
    pixels = _projected(joints_m, k)
    low, high = pixels.min(0), pixels.max(0)
    u, v = np.clip((low + high) / 2, 0, (width - 1, height - 1))
    near, far = joints_m[:, 2].min() - _BEFORE_M, joints_m[:, 2].max() + _BEHIND_M
    reach = max(_AROUND * float((high - low).max()) / 2, 8.0)
    return (float(u), float(v)), reach, 1e3 * float(near), 1e3 * float(far)


def _projected(joints_m: np.ndarray, k: np.ndarray) -> np.ndarray:
    """(21, 2) pixels of the undistorted image."""
    pixels: np.ndarray = joints_m[:, :2] / joints_m[:, 2:] * np.diag(k)[:2] + k[:2, 2]
    return pixels
