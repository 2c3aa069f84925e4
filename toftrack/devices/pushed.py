"""Frames that a program hands over, as a camera's callback does."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from toftrack.devices.base import BaseDevice
from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.frames.frame import Frame, checked_moment, wrong_unit

_LOOK_S = 0.1


class PushDevice(BaseDevice):
    """A live camera whose frames one thread pushes, its SDK's, while another one tracks; until
    `end`. Nobody waits for the tracker: it gets the newest frame, the others are `dropped`.
    """

    def __init__(self, camera: Camera, fps: float = 30.0) -> None:
        super().__init__(camera, fps, live=True)
        self._newest: queue.Queue[Frame] = queue.Queue(1)
        self._count, self._ended = 0, False

    def push(self, depth: np.ndarray, timestamp_s: float | None = None) -> None:
        """A copy of the next frame.  depth: (H, W) metres, Z.  timestamp_s: None is now.

        Raises ToftrackError here, and not where it is tracked, for what is no image of the camera.
        """
        now = time.perf_counter() if timestamp_s is None else timestamp_s
        count, time_s = checked_moment(self._count, now)
        image = np.array(depth, copy=True)
        if image.dtype.kind in "iu":
            raise wrong_unit("the depth image", image)
        if image.shape != (self.camera.height, self.camera.width) or image.dtype.kind != "f":
            raise ToftrackError(
                f"an image of {image.dtype}, shape {image.shape}, was pushed; give float metres, "
                f"{self.camera.height} rows and {self.camera.width} columns as the camera has"
            )
        with suppress(queue.Empty):
            self._newest.get_nowait()
            self.dropped += 1
        self._newest.put(Frame(count, time_s, image, None, radial=False))
        self._count += 1

    def end(self) -> None:
        """No frame comes any more."""
        self._ended = True

    def __iter__(self) -> Iterator[Frame]:
        while not (self._ended and self._newest.empty()):
            with suppress(queue.Empty):
                yield self._newest.get(timeout=_LOOK_S)
