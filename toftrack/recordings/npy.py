"""Stacks of depth images as numpy.save writes them: `.npy`, (T, H, W) or one image (H, W).

Whole numbers are steps of a millimetre, unless another unit is given; floats are metres.
"""

from __future__ import annotations

import tokenize
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.camera import Camera
from toftrack.errors import ToftrackError
from toftrack.frames import LARGEST_MEDIAN_M
from toftrack.recordings.bare import MILLIMETRE, BareFacts, bare_camera
from toftrack.recordings.npz import DEFAULT_FPS
from toftrack.safe_files import check_readable


class NpyStack:
    """The frames of a stack, mapped from the disk."""

    truth = None
    radial = False

    def __init__(
        self, path: Path, images: np.ndarray, camera: Camera, unit_m: float, fps: float
    ) -> None:
        self.path, self.camera, self.unit_m, self.fps = path, camera, unit_m, fps
        self.metadata: dict[str, Any] = {}
        self.timestamp_s = np.arange(len(images)) / fps
        """(T,) float64 seconds."""
        self._images = images

    def __len__(self) -> int:
        return len(self._images)

    def image(self, index: int) -> tuple[np.ndarray, None]:
        """A frame's depth, (H, W) float32 metres, 0 = no reading, a new array; no amplitude."""
        image = np.asarray(self._images[index])
        depth = image.astype(np.float32) * np.float32(self.unit_m)
        return np.where((depth > 0) & (depth < np.inf), depth, np.float32(0)), None

    def close(self) -> None:
        """Nothing to close: the file is mapped as long as this object lives."""


def read_npy(path: str | Path, camera_file: str | Path | None, bare: BareFacts) -> NpyStack:
    """Open a stack.

    path: the `.npy`.
    camera_file: of the camera; None = the given intrinsics, or camera.json beside the file.
    bare: intrinsics, unit of whole numbers (a millimetre) and frame rate (25) where given.

    Raises ToftrackError: it is no such stack, holds pickled objects, or nothing tells its camera.
    """
    path = Path(path).expanduser()
    images = _mapped(path)
    if images.ndim == 2:
        images = images[None]
    if images.ndim != 3 or images.size == 0 or images.dtype.kind not in "uif":
        raise ToftrackError(
            f"'{path}' has the shape {images.shape} of {images.dtype}, but must be depth images, "
            "(frames, rows, columns) of numbers"
        )
    count, height, width = images.shape
    whole = images.dtype.kind in "ui"
    unit_m = bare.unit_m if bare.unit_m is not None else (MILLIMETRE if whole else 1.0)
    stack = NpyStack(
        path,
        images,
        bare_camera(path, camera_file, bare, width, height),
        unit_m,
        DEFAULT_FPS if bare.fps is None else bare.fps,
    )
    some = np.stack(
        [stack.image(i)[0] for i in np.unique(np.linspace(0, count - 1, 8).astype(int))]
    )
    median = float(np.median(some[some > 0])) if (some > 0).any() else 0.0
    if median > LARGEST_MEDIAN_M:
        raise ToftrackError(
            f"the median of '{path}' is {median:.0f} m, which is plainly another unit; say what "
            "one step is with toftrack convert --source-unit METRES"
        )
    return stack


def _mapped(path: Path) -> np.ndarray:
    try:
        check_readable(path)
        return np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise ToftrackError(f"there is no file '{path}'; give the path of a recording") from None
    except OSError as error:
        raise ToftrackError(f"'{path}' cannot be read ({error.strerror or error})") from error
    except (
        ValueError,
        EOFError,
        TypeError,
        SyntaxError,
        OverflowError,
        tokenize.TokenError,
    ) as error:
        reason = " ".join(str(error).split())
        raise ToftrackError(
            f"'{path}' is no .npy of numbers, or was cut off ({reason}); save the depth with "
            "numpy.save"
        ) from error
