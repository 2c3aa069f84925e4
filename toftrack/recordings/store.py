"""A recording of any kind behind one face: `.npz`, `.srs`, or a folder of PNG images."""

from __future__ import annotations

from contextlib import AbstractContextManager
from importlib import resources
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from toftrack.camera import Camera
from toftrack.frames import Truth
from toftrack.recordings.npz import read_recording
from toftrack.recordings.png_folder import read_png_folder
from toftrack.recordings.sr_frame import DEFAULT_MODULATION_MHZ
from toftrack.recordings.srs import read_srs


class FrameStore(Protocol):
    """T frames in an order, each to be had by its number."""

    @property
    def camera(self) -> Camera: ...

    @property
    def fps(self) -> float: ...

    @property
    def radial(self) -> bool:
        """True: the depth is the distance along each pixel's ray; False: Z along the axis."""
        ...

    @property
    def timestamp_s(self) -> np.ndarray:
        """(T,) float64, not decreasing."""
        ...

    @property
    def truth(self) -> Truth | None: ...

    @property
    def metadata(self) -> dict[str, Any]: ...

    def __len__(self) -> int: ...

    def image(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Depth, (H, W) float32 metres, 0 = no reading, and amplitude, (H, W) uint16 or None."""
        ...

    def close(self) -> None: ...


def open_recording(
    path: str | Path,
    camera_file: str | Path | None = None,
    modulation_mhz: int = DEFAULT_MODULATION_MHZ,
) -> FrameStore:
    """Open a recording, whose kind follows from its name: a folder, `.srs`, else `.npz`.

    Only `.npz` is loaded as a whole; the others stay on the disk.

    Args:
        path: the recording.
        camera_file: serves a folder that has no camera file of its own.
        modulation_mhz: tells the range of a `.srs` that does not state it.

    Raises:
        ToftrackError: it cannot be used; one sentence that names it.
    """
    path = Path(path).expanduser()
    if path.is_dir():
        return read_png_folder(path, camera_file)
    if path.suffix.lower() == ".srs":
        return read_srs(path, modulation_mhz)
    return read_recording(path)


def open_source(name: str) -> FrameStore:
    """What a virtual camera sees: the packaged recording for `sample`, else as `open_recording`."""
    if name != "sample":
        return open_recording(name)
    with packaged_sample() as path:
        return open_recording(path)


def packaged_sample() -> AbstractContextManager[Path]:
    """The recording that comes with the package, as a file while the context is open."""
    return resources.as_file(resources.files("toftrack") / "data" / "sample.npz")
