"""What is given of a recording that does not say it: lens, unit, frame rate, and so on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toftrack.errors import ToftrackError, check_number
from toftrack.frames.camera import Camera
from toftrack.frames.frame import LARGEST_MEDIAN_M, median_reading
from toftrack.recordings.sr_frame import DEFAULT_MODULATION_MHZ

MILLIMETRE = 0.001
MOST = 1e6
"""Of a unit or a rate."""
_BESIDE = "camera.json"
_UNIT = "; say how many metres a step is with device.unit_m (convert: --source-unit)"


@dataclass(frozen=True)
class Given:
    """None = not given; ToftrackError for what cannot be meant."""

    intrinsics: Sequence[float] | None = None
    """fx, fy, cx, cy in pixels, without distortion."""
    unit_m: float | None = None
    """Metres of one step of whole numbers."""
    fps: float | None = None
    dataset: str | None = None
    """The name of the depth stack in a file that may hold several."""
    camera_file: str | Path | None = None
    topic: str | None = None
    """Of the depth images in a ROS bag that has several of them."""
    modulation_mhz: int = DEFAULT_MODULATION_MHZ
    """Tells the range of a `.srs` that does not state it."""

    def __post_init__(self) -> None:
        for name in ("unit_m", "fps"):
            if (value := getattr(self, name)) is not None:
                check_number(name, value, 0, MOST, above=True)
        if self.intrinsics is not None and not _four_numbers(self.intrinsics):
            raise ToftrackError(
                "intrinsics must be four numbers of pixels, fx, fy (above 0), cx, cy, as "
                f"[504.6,504.7,332.8,348.8], but are {self.intrinsics}"
            )
        if self.intrinsics is not None and self.camera_file is not None:
            raise ToftrackError(
                "camera.file and device.intrinsics (toftrack convert: --camera and --intrinsics) "
                "both give the lens; leave one out"
            )

    def camera(self, width: int, height: int, images: str) -> Camera | None:
        """The camera for images of that size, which are called so in errors; None: none is given.
        ToftrackError where it is of another size.
        """
        if self.camera_file is not None:
            return Camera.load_for(self.camera_file, width, height, images)
        if self.intrinsics is None:
            return None
        fx, fy, cx, cy = self.intrinsics
        return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), width, height)


def _four_numbers(values: object) -> bool:
    if isinstance(values, str) or not isinstance(values, Sequence) or len(values) != 4:
        return False
    numbers = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
    return numbers and all(map(math.isfinite, values)) and min(values[0], values[1]) > 0


NOTHING_GIVEN = Given()


def bare_camera(path: Path, given: Given, width: int, height: int) -> Camera:
    """The camera of a file of bare images of that size: as given, else camera.json beside it;
    ToftrackError where there is none, or it is of another size.
    """
    if camera := given.camera(width, height, f"'{path}'"):
        return camera
    if (beside := path.parent / _BESIDE).exists():
        return Camera.load_for(beside, width, height, f"'{path}'")
    raise ToftrackError(
        f"'{path}' ({width}x{height} pixels) does not say what camera made it; give the lens with "
        "device.intrinsics=[FX,FY,CX,CY] (toftrack convert: --intrinsics FX FY CX CY), or a camera "
        "file with camera.file=FILE (toftrack convert: --camera FILE)"
    )


def size_of(path: Path, given: Given) -> np.ndarray | None:
    """Width and height of the images, as far as the camera that is given, or lies beside, tells."""
    if given.intrinsics is not None:
        return 2 * np.array(given.intrinsics[2:]) + 1
    beside = path.parent / _BESIDE
    if given.camera_file is None and not beside.exists():
        return None
    camera = Camera.load(given.camera_file or beside)
    return np.array((camera.width, camera.height))


def metres_of(words: np.ndarray, unit_m: float) -> np.ndarray:
    """Readings as float32 metres, a new array, 0 where there are none; unit_m: metres of a step."""
    with np.errstate(over="ignore"):  # beyond float32 is infinity, and no reading
        depth = words.astype(np.float32) * np.float32(unit_m)
    return np.where((depth > 0) & (depth < np.inf), depth, np.float32(0))


def check_metres(depth_m: np.ndarray, what: str, remedy: str = _UNIT) -> None:
    """ToftrackError where depth cannot be in metres."""
    median = median_reading(depth_m)
    if median > LARGEST_MEDIAN_M:
        raise ToftrackError(
            f"the median of {what} is {median:.0f} m, which is plainly in another unit{remedy}"
        )
