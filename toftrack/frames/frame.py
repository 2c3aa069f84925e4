"""Frames of a depth camera, their ground truth, and the check of images that callers hand in."""

from __future__ import annotations

import contextlib
import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera, largest_reading
from toftrack.frames.help_text import fields_in_help

# No hand is tracked at 20 m, while 20 mm is nearer than any depth camera sees.
LARGEST_MEDIAN_M, _SMALLEST_MEDIAN_M = 20.0, 0.02
_FULL_WORDS = (65.535, 65_535.0)
"""What many cameras say where there is no reading, as everywhere before a covered lens: the largest
16-bit word, in metres and in millimetres."""
_ROUNDED = 1e-3
"""So far from it, in parts of it, is what float16 makes of it."""
NO_HAND_M = 4.0
"""No hand is tracked from farther away."""
_MILLIMETRES = (100.0, 20_000.0)
"""A median between these is one of millimetres, unless it is one of centimetres. Where as
millimetres nothing would be nearer than NO_HAND_M, it may be one of tenths, which some cameras
count."""
_NEAREST_CM, _LARGEST_CM = (15.0, 120.0), 1000.0
"""What is nearest in centimetres, and no median is more: as millimetres, these would be nearer than
cameras measure."""
LEAP_S = 3600.0
"""No camera pauses for so long: a clock was set, or the host's took the place of the camera's."""
_NEAREST_PERCENT = 5
"""So many percent of the readings may be nearer than what is called the nearest."""


def wrong_unit(what: str, depth: np.ndarray) -> ToftrackError:
    """What is said of depth, all of it or a part, whose readings' median is no distance in metres,
    or that consists of whole numbers, which are no metres whatever they are.
    """
    median, nearest = median_reading(depth), nearest_reading(depth)
    whole = f"{what} consists of whole numbers ({depth.dtype})"
    if not median:  # as a camera's first images
        return ToftrackError(
            f"{whole}, of which none is a reading that would tell their unit; give float metres "
            "(0 = no reading)"
        )
    given = f"{whole}, their median" if depth.dtype.kind in "iu" else f"the median of {what}"
    if _NEAREST_CM[0] <= nearest < _NEAREST_CM[1] and median <= _LARGEST_CM:
        unit, to_metres = "centimetres", 100
    elif _MILLIMETRES[0] <= median <= _MILLIMETRES[1] and nearest < 1000 * NO_HAND_M:
        unit, to_metres = "millimetres", 1000
    else:
        return ToftrackError(
            f"{given} is {median:.4g}, neither metres nor millimetres of a hand before a camera; "
            "find out in which unit it was recorded, and give float metres (0 = no reading)"
        )
    return ToftrackError(
        f"{given} is {median:.0f}, which is plainly {unit}, but it must be float metres; "
        f"convert with depth.astype('float32') / {to_metres}"
    )


def median_reading(depth: np.ndarray) -> float:
    """The median of what is a reading, in the unit that it has; 0 where there is none."""
    return _percentile(depth, 50)


def nearest_reading(depth: np.ndarray) -> float:
    """Likewise what nearly all readings are farther than."""
    return _percentile(depth, _NEAREST_PERCENT)


def could_be_metres(depth: np.ndarray) -> bool | None:
    """Whether its readings can be metres; None where there is none."""
    median = median_reading(depth)
    return _SMALLEST_MEDIAN_M <= median <= LARGEST_MEDIAN_M if median else None


def _percentile(depth: np.ndarray, percent: float) -> float:
    readings = depth[(depth > 0) & (depth < np.inf)].astype(np.float32)
    for full in _FULL_WORDS:
        readings = readings[abs(readings - full) > _ROUNDED * full]
    return float(np.percentile(readings, percent)) if readings.size else 0.0


@fields_in_help
@dataclass(frozen=True, eq=False)
class Frame:
    """One image as the device delivered it: neither rectified nor cleaned up."""

    index: int
    """Number of the frame within its recording, or since a live camera was opened."""
    timestamp_s: float
    """Seconds."""
    depth: np.ndarray
    """(H, W) float32 metres; 0, NaN, infinities and negative values are no reading."""
    amplitude: np.ndarray | None
    """(H, W) uint16."""
    radial: bool
    """True: `depth` is the distance along the pixel's ray; False: Z along the optical axis."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of T frames, in the order in which the device yields them."""

    joints_m: np.ndarray
    """(T, 21, 3) metres, camera frame."""
    visible: np.ndarray
    """(T,) bool: the hand is in view."""
    in_space: np.ndarray
    """(T,) bool: the pose lies in the palm-fist-pointing space."""
    visible_fraction: np.ndarray | None = None
    """(T,) share of the hand that is in view and uncovered, 0..1."""
    joint_visible: np.ndarray | None = None
    """(T, 21) bool."""
    first: int = 0
    """Number of the first row's frame; the other rows' follow where frames do."""
    other: Truth | None = None
    """Of the person's other hand, in the same frames; None where nothing is known of one."""
    pose_name: np.ndarray | None = None
    """(T,) text: which pose is held; 'transition' between two."""
    still: np.ndarray | None = None
    """(T,) bool: the hand rests."""
    side: str = ""
    """'right' or 'left'; empty where nobody says."""

    def __len__(self) -> int:
        return len(self.joints_m)

    def __getitem__(self, rows: slice) -> Truth:
        """The truth of a range of frames, by their positions."""
        return self.of_frames(self.first + np.arange(len(self))[rows])

    def of_frames(self, numbers: np.ndarray) -> Truth:
        """The truth of the frames of these numbers (n,), in their order; IndexError for others."""
        rows = np.asarray(numbers) - self.first
        if len(rows) and rows.min() < 0:
            raise IndexError(f"there is no truth of frame {rows.min() + self.first}")
        arrays: dict[str, Any] = {
            name: array[rows] for name, array in vars(self).items() if isinstance(array, np.ndarray)
        }
        first = int(numbers[0]) if len(rows) else self.first
        other = None if self.other is None else self.other.of_frames(numbers)
        return replace(self, **arrays, first=first, other=other)


@dataclass(frozen=True, eq=False)
class DepthImage:
    """One rectified frame, as the tracker takes it.

    depth_m: (H, W) float32 rectified Z, metres, 0 = no reading.  k: (3, 3) intrinsics, pixels.
    index: number of the frame.  timestamp_s: when it was taken.
    """

    depth_m: np.ndarray
    k: np.ndarray
    index: int
    timestamp_s: float


def checked_moment(index: Any, timestamp_s: Any) -> tuple[int, float]:
    """A frame's number, from 0 on, and its seconds; ToftrackError where they are none."""
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        number, seconds = int(index), float(timestamp_s)
        if number == index and number >= 0 and math.isfinite(seconds):
            return number, seconds
    raise ToftrackError(
        f"the frame's index and timestamp_s must be a whole number from 0 on and finite seconds, "
        f"but are {index!r} and {timestamp_s!r}"
    )


def checked_image(depth_m: Any, k: Any) -> tuple[np.ndarray, np.ndarray]:
    """A depth image as (H, W) float32 metres with 0 for no reading, and (3, 3) float64 intrinsics.

    NaN, infinities and negative readings become no reading. Raises ToftrackError: one of them has
    the wrong shape, type or unit.
    """
    try:
        masked = isinstance(depth_m, np.ndarray) and hasattr(depth_m, "filled")
        depth = np.asarray(depth_m.filled(0) if masked else depth_m)  # masked: no reading
        matrix = np.asarray(k)
    except (TypeError, ValueError, RuntimeError) as error:  # a ragged list, a tensor on a GPU
        raise ToftrackError(
            f"the depth image and K must be NumPy arrays, or become ones ({error})"
        ) from None
    if depth.ndim != 2 or depth.size == 0:
        raise ToftrackError(
            f"the depth image must have two dimensions (rows, columns), but its shape is "
            f"{depth.shape}; give one frame at a time"
        )
    if depth.dtype.kind in "iu":
        raise wrong_unit("the depth image", depth)
    if depth.dtype.kind != "f":
        raise ToftrackError(f"the depth image must be float32 metres, but is {depth.dtype}")
    with np.errstate(over="ignore"):  # beyond float32 is infinity, and no reading
        depth = np.ascontiguousarray(depth, np.float32)
    farthest = largest_reading(depth)
    if farthest == np.inf:
        depth = np.where((depth > 0) & (depth < np.inf), depth, np.float32(0))
        farthest = largest_reading(depth)
    if farthest > LARGEST_MEDIAN_M and median_reading(depth) > LARGEST_MEDIAN_M:
        raise wrong_unit("the depth image", depth)
    if matrix.shape != (3, 3) or matrix.dtype != np.float64:
        return depth, Camera(matrix, depth.shape[1], depth.shape[0]).K
    return depth, _intrinsics(matrix.tobytes(), depth.shape[1], depth.shape[0])


@functools.lru_cache(16)
def _intrinsics(entries: bytes, width: int, height: int) -> np.ndarray:
    """(3, 3) float64 that Camera accepts: most frames have the ones of the frame before."""
    return Camera(np.frombuffer(entries).reshape(3, 3), width, height).K
