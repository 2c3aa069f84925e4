"""A folder of 16-bit PNG depth images played back as if it were a camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.recordings.bare import BareFacts
from toftrack.recordings.png_folder import read_png_folder


class Folder(Replay):
    """The images of a folder, as `Replay`; what the folder does not state can be given.

    Args:
        path: the folder; see `toftrack.recordings.png_folder` for what lies in it.
        unit_m: metres of one step of the images; None = as the folder says, else 0.001.
        fps: frames a second; None = as the folder says, else 25.
        intrinsics: fx, fy, cx, cy in pixels, without distortion, instead of the folder's camera.
        camera_file, start, stop, realtime, repeat: as for `Replay`.

    Raises:
        ToftrackError: as `Replay`, and when the images are not 16-bit grey PNGs of one size.
    """

    def __init__(
        self,
        path: str | Path,
        unit_m: float | None = None,
        fps: float | None = None,
        camera_file: str | Path | None = None,
        intrinsics: Sequence[float] | None = None,
        **playback: Any,
    ) -> None:
        if not path:
            raise ToftrackError("no folder was given; set device.path=FOLDER")
        store = read_png_folder(path, camera_file, BareFacts(intrinsics, unit_m, fps))
        playback |= {"camera_file": camera_file, "intrinsics": intrinsics}
        super().__init__(path, store=store, **playback)
        self.description |= {"device": "folder", "unit_m": store.unit_m}
