"""Recordings played back as if they were cameras."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.devices.base import BaseDevice
from toftrack.errors import ToftrackError, check_number
from toftrack.frames.frame import Frame
from toftrack.recordings.bare import Given
from toftrack.recordings.doubts import doubts
from toftrack.recordings.frame_store import FrameStore
from toftrack.recordings.store import FIRST_SAMPLE, open_recording, open_sample, sample_file

_log = logging.getLogger(__name__)


class Replay(BaseDevice):
    """The frames of a recording of any kind; the arguments are those of conf/device/replay.yaml.

    Each frame keeps its index within the recording; `truth` is that of the range. With `repeat`
    indices and timestamps go on counting from one round to the next, as a camera's would; there is
    no last frame then, so `frames` is None, and so is `truth`, which has a row for each of them.

    realtime: each frame has its time, counted from when the first one is done, and is dropped when
    the next one is already due (the last is always delivered).  store: the recording, where it is
    open already.  given: the fields of `Given`; a camera goes before the recording's own. Raises
    ToftrackError: the recording or the camera cannot be used, or the range lies outside.
    """

    def __init__(
        self,
        path: str | Path,
        start: int = 0,
        stop: int | None = None,
        realtime: bool = False,
        repeat: bool = False,
        store: FrameStore | None = None,
        **given: Any,
    ) -> None:
        if not path:
            raise ToftrackError("no recording to replay was given; set device.path=PATH")
        known = Given(**given)
        if store is None:
            store = open_recording(path, known)
        self._recording = store
        if store.damage:
            _log.warning("%s: %s; its %d whole frames are used", path, store.damage, len(store))
        if store.left_out:
            _log.warning("%s: %s", path, store.left_out)
        self._range = rows = _checked_range(start, stop, len(store), path)
        self._times_s = store.timestamp_s[rows.start : rows.stop]
        self._round_s = float(self._times_s[-1] - self._times_s[0]) + 1 / store.fps
        """From a frame to the same one in the next round; the last one lasts one frame's time."""
        self._realtime, self._repeat = bool(realtime), bool(repeat)
        size = store.camera.width, store.camera.height
        camera = known.camera(*size, f"'{path}'") or store.camera
        found = doubts(store, camera)
        for doubt in found:
            _log.warning("%s: %s", path, doubt)
        truth = None if self._repeat else store.truth
        super().__init__(
            camera,
            store.fps,
            frames=None if self._repeat else len(rows),
            truth=None if truth is None else truth[rows.start : rows.stop],
            live=self._realtime,
        )
        self.metadata = store.metadata
        self.description: dict[str, Any] = {
            "device": "replay",
            "recording": str(path),
            "start": rows.start,
            "stop": rows.stop,
            "realtime": self._realtime,
            "repeat": self._repeat,
            "camera_file": None if known.camera_file is None else str(known.camera_file),
            "doubts": list(found),
        }
        if store.names:
            self.description["files"] = list(store.names)
        if "topic" in store.metadata:
            self.description["topic"] = store.metadata["topic"]

    def close(self) -> None:
        self._recording.close()

    def __iter__(self) -> Iterator[Frame]:
        self.dropped, begin = 0, math.nan
        count, last = 0, math.inf if self._repeat else len(self._range) - 1
        try:
            while count <= last:
                if self._realtime and count:
                    count = self._paced(count, last, time.perf_counter() - begin)
                yield self._frame(count)
                if not count:  # much is loaded for the first one, which a recording can wait for
                    begin = time.perf_counter()
                count += 1
        finally:
            self._recording.close()

    def _paced(self, count: int, last: float, elapsed_s: float) -> int:
        """The count of the frame whose turn it is, when it is due; `dropped` are left out."""
        newest = int(min(self._due(elapsed_s), last))
        if newest > count:
            self.dropped += newest - count
            return newest
        time.sleep(max(0.0, self._time_s(count) - self._time_s(0) - elapsed_s))
        return count

    def _due(self, elapsed_s: float) -> int:
        """The count of the newest frame that is due so long after the first one."""
        times_s = self._times_s
        rounds, within_s = divmod(elapsed_s, self._round_s) if self._repeat else (0, elapsed_s)
        row = int(np.searchsorted(times_s, times_s[0] + within_s, side="right")) - 1
        return int(rounds) * len(times_s) + row

    def _time_s(self, count: int) -> float:
        rounds, row = divmod(count, len(self._range))
        return float(self._times_s[row]) + rounds * self._round_s

    def _frame(self, count: int) -> Frame:
        recording = self._recording
        depth, amplitude = recording.image(self._range[count % len(self._range)])
        return Frame(
            index=self._range.start + count,
            timestamp_s=self._time_s(count),
            depth=depth,
            amplitude=amplitude,
            radial=recording.radial,
        )


class Sample(Replay):
    """A recording that comes with the package, with ground truth; as `Replay`."""

    def __init__(self, name: str = FIRST_SAMPLE, **playback: Any) -> None:
        # Where the package happens to be installed says nothing about the result.
        super().__init__(f"toftrack/data/{sample_file(name)}", store=open_sample(name), **playback)
        self.description |= {"device": "sample", "name": name}


def _checked_range(start: int, stop: int | None, count: int, path: str | Path) -> range:
    stop = count if stop is None else stop
    check_number("device.start", start, whole=True)
    check_number("device.stop", stop, whole=True)
    if not 0 <= start < stop <= count:
        raise ToftrackError(
            f"the frames from device.start={start} to device.stop={stop} do not lie in '{path}', "
            f"which has {count} frames; choose 0 <= start < stop <= {count}"
        )
    return range(start, stop)
