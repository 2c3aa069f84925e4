"""Images that say nothing of lens, unit and frame rate: what is given instead."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toftrack.errors import ToftrackError, check_number
from toftrack.frames.camera import Camera
from toftrack.frames.frame import LARGEST_MEDIAN_M, median_reading

MILLIMETRE = 0.001
MOST = 1e6
"""Of a unit or a rate."""
_BESIDE = "camera.json"


@dataclass(frozen=True)
class BareFacts:
    """None = not given; ToftrackError for what cannot be meant."""

    intrinsics: Sequence[float] | None = None
    """fx, fy, cx, cy in pixels, without distortion."""
    unit_m: float | None = None
    """Metres of one step of whole numbers."""
    fps: float | None = None
    dataset: str | None = None
    """The name of the depth stack in a file that may hold several."""

    def __post_init__(self) -> None:
        for name in ("unit_m", "fps"):
            if (value := getattr(self, name)) is not None:
                check_number(name, value, 0, MOST, above=True)
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
    if camera_file is None and (given := bare.camera(width, height)):
        return given
    beside = path.parent / _BESIDE
    if camera_file is not None or beside.exists():
        file = beside if camera_file is None else camera_file
        return Camera.load_for(file, width, height, f"'{path}'")
    raise ToftrackError(
        f"'{path}' ({width}x{height} pixels) does not say what camera made it; give the lens with "
        "device.intrinsics=[FX,FY,CX,CY] (toftrack convert: --intrinsics FX FY CX CY), or a camera "
        "file with camera.file=FILE (toftrack convert: --camera FILE)"
    )


def size_of(path: Path, camera_file: str | Path | None, bare: BareFacts) -> np.ndarray | None:
    """Width and height of the images, as far as the camera that is given, or lies beside, tells."""
    beside = path.parent / _BESIDE
    if camera_file is not None or bare.intrinsics is None and beside.exists():
        camera = Camera.load(camera_file or beside)
        return np.array((camera.width, camera.height))
    return None if bare.intrinsics is None else 2 * np.array(bare.intrinsics[2:]) + 1


def check_metres(depth_m: np.ndarray, what: str, remedy: str) -> None:
    """ToftrackError where depth cannot be in metres."""
    median = median_reading(depth_m)
    if median > LARGEST_MEDIAN_M:
        raise ToftrackError(
            f"the median of {what} is {median:.0f} m, which is plainly another unit{remedy}"
        )
