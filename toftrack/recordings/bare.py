"""Images that say nothing of lens, unit and frame rate: what is given instead; `.npy` stacks."""

from __future__ import annotations

import math
import tokenize
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.frames.frame import LARGEST_MEDIAN_M, median_reading
from toftrack.recordings.frame_store import DEFAULT_FPS, FrameStore, file_of, reading

MILLIMETRE = 0.001
_BESIDE = "camera.json"
_BROKEN = (ValueError, EOFError, TypeError, SyntaxError, OverflowError, tokenize.TokenError)
"""What numpy raises of a damaged `.npy`."""


@dataclass(frozen=True)
class BareFacts:
    """None = not given; ToftrackError for what cannot be meant."""

    intrinsics: Sequence[float] | None = None
    """fx, fy, cx, cy in pixels, without distortion."""
    unit_m: float | None = None
    """Metres of one step of whole numbers."""
    fps: float | None = None

    def __post_init__(self) -> None:
        for name in ("unit_m", "fps"):
            value = getattr(self, name)
            if value is not None and not is_positive(value):
                raise ToftrackError(f"{name} must be a positive number, but is {value!r}")
        if self.intrinsics is not None and not _four_numbers(self.intrinsics):
            raise ToftrackError(
                "intrinsics must be four numbers of pixels, fx, fy (above 0), cx, cy, as "
                f"[504.6,504.7,332.8,348.8], but are {self.intrinsics}"
            )

    def camera(self, width: int, height: int) -> Camera | None:
        """The camera of the intrinsics for images of that size; None when they are not given."""
        if self.intrinsics is None:
            return None
        fx, fy, cx, cy = self.intrinsics
        return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), width, height)


def is_positive(value: object) -> bool:
    """Whether it is a number above 0 that may be a unit or a rate."""
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < 1e6


def _four_numbers(values: object) -> bool:
    if isinstance(values, str) or not isinstance(values, Sequence) or len(values) != 4:
        return False
    numbers = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
    return numbers and all(map(math.isfinite, values)) and min(values[0], values[1]) > 0


NOTHING_GIVEN = BareFacts()


def bare_camera(
    path: Path, camera_file: str | Path | None, bare: BareFacts, width: int, height: int
) -> Camera:
    """The camera of a file of bare images of that size: as given, else camera.json beside it;
    ToftrackError where there is none, or it is of another size.
    """
    if camera_file is not None:
        return Camera.load_for(camera_file, width, height, f"'{path}'")
    given = bare.camera(width, height)
    if given is not None:
        return given
    beside = path.parent / _BESIDE
    if beside.exists():
        return Camera.load_for(beside, width, height, f"'{path}'")
    raise ToftrackError(
        f"'{path}' ({width}x{height} pixels) does not say what camera made it; give the lens with "
        "device.intrinsics=[FX,FY,CX,CY] (toftrack convert: --intrinsics FX FY CX CY), or a camera "
        "file with camera.file=FILE (toftrack convert: --camera FILE)"
    )


class NpyStack(FrameStore):
    """The frames of a stack, mapped from the disk as long as this object lives."""

    def __init__(self, images: np.ndarray, camera: Camera, bare: BareFacts) -> None:
        whole = images.dtype.kind in "ui"
        self.camera, self.metadata = camera, {}
        self.unit_m = bare.unit_m or (MILLIMETRE if whole else 1.0)
        self.fps = bare.fps or DEFAULT_FPS
        self.timestamp_s = np.arange(len(images)) / self.fps
        self._images = images

    def image(self, index: int) -> tuple[np.ndarray, None]:
        image = np.asarray(self._images[index])
        depth = image.astype(np.float32) * np.float32(self.unit_m)
        return np.where((depth > 0) & (depth < np.inf), depth, np.float32(0)), None


def read_npy(path: str | Path, camera_file: str | Path | None, bare: BareFacts) -> NpyStack:
    """Open a stack.

    camera_file: None = the given intrinsics, or camera.json beside the file.  bare: intrinsics,
    unit of whole numbers (a millimetre) and frame rate (25) where given. Raises ToftrackError: it
    is no such stack, holds pickled objects, or nothing tells its camera.
    """
    path = file_of(path)
    try:
        with reading(path):
            images = np.load(path, mmap_mode="r", allow_pickle=False)
    except _BROKEN as error:
        reason = " ".join(str(error).split())
        raise ToftrackError(
            f"'{path}' is no .npy of numbers, or was cut off ({reason}); save the depth with "
            "numpy.save"
        ) from error
    if images.ndim == 2:
        images = images[None]
    if images.ndim != 3 or images.size == 0 or images.dtype.kind not in "uif":
        raise ToftrackError(
            f"'{path}' has the shape {images.shape} of {images.dtype}, but must be depth images, "
            "(frames, rows, columns) of numbers"
        )
    count, height, width = images.shape
    stack = NpyStack(images, bare_camera(path, camera_file, bare, width, height), bare)
    some = [stack.image(i)[0] for i in np.unique(np.linspace(0, count - 1, 8).astype(int))]
    remedy = "; say what one step is with toftrack convert --source-unit METRES"
    check_metres(np.stack(some), f"'{path}'", remedy)
    return stack


def check_metres(depth_m: np.ndarray, what: str, remedy: str) -> None:
    """ToftrackError where depth cannot be in metres."""
    median = median_reading(depth_m)
    if median > LARGEST_MEDIAN_M:
        raise ToftrackError(
            f"the median of {what} is {median:.0f} m, which is plainly another unit{remedy}"
        )
