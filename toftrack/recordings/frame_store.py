"""What every recording is when it is open: frames with a camera."""

from __future__ import annotations

import os
from abc import abstractmethod
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.safe_files import check_readable
from toftrack.frames.camera import Camera
from toftrack.frames.frame import Truth

DEFAULT_FPS = 25.0


@dataclass(init=False, eq=False, repr=False, kw_only=True)
class FrameStore:
    """T frames in an order, each to be had by its number. Opening one raises ToftrackError, one
    sentence that names the file: it is missing, damaged or of another kind, or nothing tells its
    camera.
    """

    camera: Camera
    fps: float
    timestamp_s: np.ndarray
    """(T,) float64, not decreasing."""
    metadata: dict[str, Any] = field(default_factory=dict)
    radial: bool = False
    """True: the depth is the distance along each pixel's ray; False: Z along the axis."""
    truth: Truth | None = None
    unit_m: float | None = None
    """Metres of one step, where the images are whole numbers."""
    names: tuple[str, ...] = ()
    """Of the frames' files, (T,), where each has one of its own."""
    damage: str | None = None
    """Why it ends earlier than it should, in words; None when it is whole."""
    left_out: str | None = None
    """What lies beside the frames and is not used, in words."""

    def __len__(self) -> int:
        return len(self.timestamp_s)

    @abstractmethod
    def image(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Depth, (H, W) float32 metres, 0 = no reading, a new array, and amplitude, (H, W) uint16
        or None. Raises ToftrackError when it cannot be read, is damaged, or of another size.
        """

    def close(self) -> None:
        """Close the file, if one is open; it opens again by itself."""


def file_of(path: str | Path) -> Path:
    """The path of a recording that is one file; ToftrackError where there is no file, or none to be
    opened.
    """
    path, give = Path(os.path.expanduser(path)), "give the path of a recording"
    with reading(path):  # too long a name
        if path.is_dir():
            raise ToftrackError(f"'{path}' is a directory; {give}")
        if not path.exists():
            raise ToftrackError(f"there is no file '{path}'; {give}")
        check_readable(path)
    return path


def reading(path: Path) -> AbstractContextManager[None]:
    """What the system says of a recording becomes one sentence."""
    what = f"the recording '{path}' cannot be read"
    return reported_errors(what, "check the file and its permissions")


def rate_of(timestamp_s: np.ndarray, otherwise: float = DEFAULT_FPS) -> float:
    """Frames a second, by the median step of times; otherwise: where they do not tell it."""
    median = float(np.median(np.diff(timestamp_s))) if len(timestamp_s) > 1 else 0.0
    return 1.0 / median if median > 0 else otherwise
