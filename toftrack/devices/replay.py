"""A recording played back as if it were a camera."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np

from toftrack.camera import Camera
from toftrack.devices.base import Frame
from toftrack.errors import ToftrackError
from toftrack.recordings.sr_frame import DEFAULT_MODULATION_MHZ
from toftrack.recordings.store import FrameStore, open_recording

_log = logging.getLogger(__name__)


class Replay:
    """The frames of a recording, from `start` up to but not including `stop`.

    Each frame keeps its index within the recording; `truth` is that of the range.

    A `.npz` is loaded; a `.srs` and a folder of images are read frame by frame, so that long ones
    need no more memory than short ones.

    Args:
        path: the recording: `.npz`, `.srs`, or a folder of 16-bit PNG images with a camera file.
        start: first frame.
        stop: the frame after the last; None for all.
        realtime: at the recording's own pace: wait for each frame's time, and drop a frame when the
            next one is already due (the last is always delivered). Otherwise every frame, as fast
            as it is asked for.
        camera_file: a calibrated camera instead of the recording's own.
        modulation_mhz: of the SR3000, for a `.srs` that does not state its range.

    Raises:
        ToftrackError: the recording or the camera cannot be used, or the range lies outside.
    """

    def __init__(
        self,
        path: str | Path,
        start: int = 0,
        stop: int | None = None,
        realtime: bool = False,
        camera_file: str | Path | None = None,
        modulation_mhz: int = DEFAULT_MODULATION_MHZ,
    ) -> None:
        if not path:
            raise ToftrackError("no recording to replay was given; set device.path=FILE.npz")
        store = open_recording(path, camera_file, modulation_mhz)
        self._set_up(store, path, start, stop, realtime, camera_file)

    def _set_up(
        self,
        store: FrameStore,
        path: str | Path,
        start: int,
        stop: int | None,
        realtime: bool,
        camera_file: str | Path | None,
    ) -> None:
        self._recording = store
        damage = getattr(store, "damage", None)
        if damage:
            _log.warning("%s: %s; its %d whole frames are used", path, damage, len(store))
        self._range = _checked_range(start, stop, len(self._recording), path)
        self._realtime = bool(realtime)
        self.camera = _camera(self._recording, camera_file, path)
        self.fps = self._recording.fps
        self.frames: int | None = len(self._range)
        truth = self._recording.truth
        self.truth = None if truth is None else truth[self._range.start : self._range.stop]
        self.metadata: dict[str, Any] = self._recording.metadata
        self.description: dict[str, Any] = {
            "device": "replay",
            "recording": str(path),
            "start": self._range.start,
            "stop": self._range.stop,
            "realtime": self._realtime,
            "camera_file": None if camera_file is None else str(camera_file),
        }
        self.dropped = 0
        """Frames that came too late in the latest iteration; always 0 unless `realtime`."""

    def open(self) -> None:
        """Nothing to open: the file was checked by the constructor."""

    def close(self) -> None:
        """Close the recording's file, if it is open."""
        self._recording.close()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Frame]:
        self.dropped = 0
        indices = self._paced() if self._realtime else iter(self._range)
        try:
            for index in indices:
                yield self._frame(index)
        finally:
            self._recording.close()

    def _paced(self) -> Iterator[int]:
        due = self._recording.timestamp_s[self._range.start : self._range.stop]
        begin = time.monotonic()
        row, last = 0, len(due) - 1
        while row <= last:
            now = time.monotonic() - begin + due[0]
            newest = min(int(np.searchsorted(due, now, side="right")) - 1, last)
            if newest > row:
                self.dropped += newest - row
                row = newest
            elif due[row] > now:
                time.sleep(due[row] - now)
            yield self._range[row]
            row += 1

    def _frame(self, index: int) -> Frame:
        recording = self._recording
        depth, amplitude = recording.image(index)
        return Frame(
            index=index,
            timestamp_s=float(recording.timestamp_s[index]),
            depth=depth,
            amplitude=amplitude,
            radial=recording.radial,
        )


def _checked_range(start: int, stop: int | None, count: int, path: str | Path) -> range:
    for name, value in (("start", start), ("stop", stop)):
        whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
        if not whole and not (name == "stop" and value is None):
            raise ToftrackError(
                f"{name}={value!r} is not a frame number; give a whole number from 0 to {count}"
            )
    stop = count if stop is None else stop
    if not 0 <= start < stop <= count:
        raise ToftrackError(
            f"the frames from start={start} to stop={stop} do not lie in '{path}', which has "
            f"{count} frames; choose 0 <= start < stop <= {count}"
        )
    return range(start, stop)


def _camera(recording: FrameStore, camera_file: str | Path | None, path: str | Path) -> Camera:
    own = recording.camera
    if camera_file is None:
        return own
    camera = Camera.load(camera_file)
    if (camera.width, camera.height) != (own.width, own.height):
        raise ToftrackError(
            f"the camera file '{camera_file}' is for {camera.width}x{camera.height} pixels, but "
            f"'{path}' has {own.width}x{own.height}; use the camera that made the recording"
        )
    return camera
