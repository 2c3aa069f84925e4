"""Labels of points in the making: which frames to label, where the hand is in them, what the
tracker says of them, and a file that grows click by click."""

from __future__ import annotations

import sys
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hydra.utils import instantiate
from omegaconf import DictConfig
from tqdm import tqdm

from toftrack.api import build_tracker
from toftrack.compute.threads import small_operations
from toftrack.configuration.compose import one_sentence
from toftrack.detector.hand_detector import HandDetector
from toftrack.devices.base import Device
from toftrack.errors import ToftrackError, reported_errors
from toftrack.evaluation.image_labels import Points, read_labels
from toftrack.files.json_text import write_json
from toftrack.frames.camera import Camera
from toftrack.hand.skeleton import FINGERS

TIPS = tuple(f"{finger}_tip" for finger in FINGERS)
LABELLED = (*TIPS, *(f"{finger}_mcp" for finger in FINGERS), "wrist")
"""The joints that are asked for, in this order."""
_CONVENTIONS = (
    "pixels of the undistorted image, centres at whole numbers; frames by their number in the "
    "recording; tips 5 mm inside the end of the finger"
)
_AROUND = 1.7
"""How much more than the hand is shown."""
_BEFORE_M, _BEHIND_M = 0.03, 0.05
"""Of the depths that contrast is given to, beside those of the hand's joints."""


def chosen_frames(
    count: int,
    wanted: int,
    given: Collection[int] = (),
    confidence: np.ndarray | None = None,
) -> list[int]:
    """Numbers of frames to label, rising: those `given`, and others until there are `wanted`.

    confidence: (count,) of each frame: the least confident ones are taken, apart from each other
    where there are enough. None: evenly spaced ones.
    """
    chosen, wanted = set(given), min(wanted, count)
    if confidence is None and not chosen:
        return sorted({int((part + 0.5) * count / wanted) for part in range(wanted)})
    if confidence is None:
        away = np.abs(np.arange(count)[:, None] - np.array(sorted(chosen))).min(1)
        while len(chosen) < wanted:
            farthest = int(away.argmax())
            chosen.add(farthest)
            away = np.minimum(away, np.abs(np.arange(count) - farthest))
        return sorted(chosen)
    apart = count // (2 * wanted)
    while len(chosen) < wanted:
        for number in np.argsort(confidence, kind="stable").tolist():
            if len(chosen) < wanted and all(abs(number - one) > apart for one in chosen):
                chosen.add(number)
        apart //= 2
    return sorted(chosen)


class Tracked(NamedTuple):
    """What the tracker says of T frames.

    joints_m: (T, 21, 3), NaN where the hand is lost.
    confidence: (T,), 0 where the hand is lost; 1 where nobody finds one, so that such come last.
    """

    joints_m: np.ndarray
    confidence: np.ndarray


def track(device: Device, config: DictConfig) -> Tracked:
    """Track all of a recording, with a configuration of one hand. Raises ToftrackError."""
    with one_sentence():
        tracker, detector = build_tracker(config), instantiate(config.detector)
    camera, joints, confidence = device.camera, [], []
    for frame in tqdm(device, total=device.frames, unit=" frames", file=sys.stderr, disable=None):
        depth_m = camera.rectify(frame.depth, frame.radial)
        estimate = tracker.step(depth_m, camera.K, frame.index, frame.timestamp_s)
        joints.append(np.where(estimate.lost, np.float32(np.nan), estimate.joints_m))
        if not estimate.lost:
            confidence.append(float(np.nan_to_num(estimate.confidence)))
        else:
            nobody = detector is not None and _found(detector, depth_m, camera.K) is None
            confidence.append(float(nobody))
    return Tracked(np.array(joints), np.array(confidence))


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


def label_frames(
    device: Device,
    config: DictConfig,
    numbers: Collection[int],
    known: Tracked | None = None,
) -> list[LabelFrame]:
    """The frames of these numbers, rising, ready to be shown, with what the tracker says of them
    where it is known. Raises ToftrackError when the frames are not those of a whole recording."""
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
            joints = None if known is None else known.joints_m[row]
            if joints is not None and np.isnan(joints).any():
                joints = None
            seen = _found(detector, depth_m, camera.K) if joints is None else joints
            depth_mm = np.clip(1e3 * depth_m + 0.5, 0, 65535).astype("<u2")
            pixels = None if joints is None else camera.project(joints)
            shown.append(LabelFrame(row, depth_mm, *_about(seen, depth_m, camera), pixels))
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
    joints_m: np.ndarray | None, depth_m: np.ndarray, camera: Camera
) -> tuple[tuple[float, float], float, float, float]:
    """Centre, reach, near and far of what is shown: the whole image where no hand is known."""
    height, width = depth_m.shape
    if joints_m is None or not np.isfinite(joints_m).all() or joints_m[:, 2].min() <= 0:
        seen = depth_m[depth_m > 0]
        near, far = np.percentile(seen, (1, 50)) if seen.size else (0.2, 1.0)
        return ((width - 1) / 2, (height - 1) / 2), max(width, height) / 2, 1e3 * near, 1e3 * far
    pixels = camera.project(joints_m)
    low, high = pixels.min(0), pixels.max(0)
    u, v = np.clip((low + high) / 2, 0, (width - 1, height - 1))
    near, far = joints_m[:, 2].min() - _BEFORE_M, joints_m[:, 2].max() + _BEHIND_M
    reach = max(_AROUND * float((high - low).max()) / 2, 8.0)
    return (float(u), float(v)), reach, 1e3 * float(near), 1e3 * float(far)


class LabelFile:
    """Labels of a recording's frames; every change is in the file when its call returns.

    A file that is there is continued: what it holds stays, also what is not known here. None is
    made before the side is known.
    """

    def __init__(
        self, path: str | Path, recording: str, size: tuple[int, int], count: int, side: str | None
    ) -> None:
        """Begin a file, or continue it.

        recording: name of the recording's file.  size: (width, height) of its images.  count: of
        its frames.  side: "right" or "left"; None = as the file says, or not known yet.
        Raises ToftrackError: the file is not of this recording and side, or cannot be read.
        """
        self.path, self._size = Path(path).expanduser(), size
        if self.path.exists():
            self.content = self._continued(recording, count, side)
        else:
            self.content = {
                "recording": recording,
                "conventions": _CONVENTIONS,
                "side": side,
                "image_size": list(size),
                "frames": {},
            }

    @property
    def frames(self) -> dict[str, dict[str, Any]]:
        """By number, as text: `points` by joint, each (u, v, flag), and perhaps `gesture`."""
        found: dict[str, dict[str, Any]] = self.content["frames"]
        return found

    def numbers(self) -> list[int]:
        """The frames that are labelled, or are to be."""
        return sorted(map(int, self.frames))

    def labelled(self) -> int:
        """How many frames have a visible fingertip, which is what is measured."""
        return sum(
            any(frame["points"].get(tip, (0, 0, ""))[2] == "visible" for tip in TIPS)
            for frame in self.frames.values()
        )

    def begin(self, numbers: Collection[int]) -> None:
        """Take up frames, with nothing in them unless they are there."""
        for number in numbers:
            self.frames.setdefault(str(number), {"points": {}})
        self.save()

    def set_side(self, side: object) -> None:
        """Say whose hand it is; ValueError for what is no side."""
        if side not in ("right", "left"):
            raise ValueError("the side is right or left")
        self.content["side"] = side
        self.save()

    def set_gesture(self, number: object, name: object) -> None:
        """Name a frame's gesture, None takes it back; ValueError for a frame not taken up."""
        frame = self._frame(number)
        if not (name is None or (isinstance(name, str) and len(name) < 100)):
            raise ValueError("a gesture is a short name")
        frame.pop("gesture", None)
        if name is not None:
            frame["gesture"] = name
        self.save()

    def set_point(self, number: object, joint: object, point: object) -> None:
        """Set a joint to [u, v, "visible" or "guessed"] in pixels, to [None, None, "absent"], or
        with None take it back. ValueError for anything else, or before the side is known."""
        points = self._frame(number)["points"]
        if self.content["side"] is None:
            raise ValueError("say first whether it is a right or a left hand")
        if joint not in LABELLED:
            raise ValueError("there is no such joint to label")
        if point is None:
            points.pop(joint, None)
        else:
            points[joint] = self._checked(point)
        self.save()

    def save(self) -> None:
        """Write the file as a whole; ToftrackError where it cannot be."""
        if self.content["side"] is None:
            return
        frames = {number: self.frames[number] for number in map(str, self.numbers())}
        what, remedy = f"the labels '{self.path}' cannot be written", "give another --output"
        with reported_errors(what, remedy, OSError, ValueError):  # what else is there may be NaN
            write_json(self.path, self.content | {"frames": frames}, allow_nan=False)

    def _frame(self, number: object) -> dict[str, Any]:
        if str(number) not in self.frames:
            raise ValueError("that frame is not to be labelled")
        return self.frames[str(number)]

    def _checked(self, point: object) -> list[Any]:
        if not isinstance(point, list) or len(point) != 3:
            raise ValueError("a point is [u, v, flag]")
        if point == [None, None, "absent"]:
            return point
        *place, flag = point
        inside = all(
            type(one) in (int, float) and -0.5 <= one <= most - 0.5
            for one, most in zip(place, self._size, strict=True)
        )
        if not inside or flag not in ("visible", "guessed"):
            raise ValueError("a point is visible or guessed, and within the image")
        return [*(round(float(one), 2) for one in place), flag]

    def _continued(self, recording: str, count: int, side: str | None) -> dict[str, Any]:
        known = read_labels(self.path, begun=True)
        if not isinstance(known, Points):
            why = "of stills, not of points"
        elif (
            known.size != self._size
            or max(known.frames, default=0) >= count
            or known.content.get("recording", recording) != recording
        ):
            why = f"of another recording than '{recording}'"
        elif side not in (None, known.side):
            why = f"of a {known.side} hand"
        else:
            return known.content
        raise ToftrackError(f"the labels '{self.path}' are {why}; give another --output")
