"""An Orbbec depth camera, live or recorded, through the vendor's SDK (pyorbbecsdk2)."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.camera import Camera
from toftrack.devices.base import BaseDevice
from toftrack.devices.live import FrameNumbers, check_live, recording_index_error, reported_errors
from toftrack.devices.orbbec import sdk
from toftrack.errors import ToftrackError
from toftrack.frames import Frame

_log = logging.getLogger(__name__)
_SLICE_S = 0.1  # of waiting, between looks at what else may have happened
_OTHER = "choose another file"
_BUSY = (
    "close other programs that use it, plug it in again, into a USB 3 port, and on Linux install "
    "its udev rules"
)


class Orbbec(BaseDevice):
    """Depth as Z along the optical axis, infrared as amplitude, by the camera's own intrinsics.

    The index is the camera's frame number, counted from the first frame; what was dropped leaves a
    gap. Leaving the iteration stops the camera, another iteration starts it again.

    Args:
        bag: a recording of the SDK (`.bag`) instead of a camera.
        serial: which camera; None = the only one.
        width, height, fps: of the images; None = as the camera proposes.
        infrared: deliver infrared images of the same size as amplitude, where there are any.
        keep: `newest` delivers the newest frame and drops older ones that nobody has taken;
            `every` lets up to `queue_frames` wait. A recording plays at its own pace.
        queue_frames: see `keep`.
        start: first frame; the ones before are left out.
        stop: end before this index; None = go on.
        timeout_s: so long without a frame means that the camera does not answer.
        camera_file: a calibrated camera instead of the camera's own intrinsics.

    Raises:
        ToftrackError: a setting makes no sense, pyorbbecsdk2 is not installed, there is no camera,
            the recording cannot be used, or there are no depth images of that size.
    """

    def __init__(
        self,
        bag: str | Path | None,
        serial: str | int | None,
        width: int | None,
        height: int | None,
        fps: int | None,
        infrared: bool,
        keep: str,
        queue_frames: int,
        start: int,
        stop: int | None,
        timeout_s: float,
        camera_file: str | Path | None,
    ) -> None:
        check_live("orbbec", keep, queue_frames, start, stop, timeout_s)
        path = None if bag is None else Path(bag).expanduser()
        if path is not None and not path.is_file():
            raise ToftrackError(f"there is no file '{bag}'; give a recording with device.bag=FILE")
        ob = self._ob = sdk.load_sdk()
        self._errors = sdk.errors(ob)
        if path is not None:
            owner = f"'{bag}'"
            with reported_errors(
                f"{owner} is not a recording of an Orbbec camera", _OTHER, self._errors
            ):
                device, number = ob.PlaybackDevice(str(path)), ""
        else:
            device, number = sdk.find_camera(ob, None if serial is None else str(serial))
            owner = "the camera"
        remedy = _BUSY if path is None else _OTHER
        with reported_errors(f"{owner} cannot be used", remedy, self._errors):
            pipeline = ob.Pipeline(device)
            self._streams = sdk.choose_streams(ob, pipeline, (width, height, fps), infrared, owner)
            depth = self._streams.depth
            size = depth.get_width(), depth.get_height()
            if camera_file is None:
                camera = sdk.camera_of(ob, depth)
            else:
                camera = Camera.load_for(camera_file, *size, owner)
            about = sdk.facts(device)
        super().__init__(camera, depth.get_fps() or 30.0, live=keep == "newest")
        self._device, self._serial, self._path = device, number, path
        self._pipeline, self._running = pipeline, False
        self._start, self._stop, self._timeout_s = start, stop, timeout_s
        self._waiting: deque[Any] = deque(maxlen=queue_frames if keep == "every" else 1)
        self._came = threading.Condition()
        if path is None and stop is not None:
            self.frames = stop - start
        self.description = {
            "device": "orbbec",
            "recording": None if bag is None else str(bag),
            **about,
            "size": list(size),
            "fps": self.fps,
            "infrared": self._streams.infrared is not None,
            "keep": keep,
            "start": start,
            "stop": stop,
            "camera_file": None if camera_file is None else str(camera_file),
        }

    def open(self) -> None:
        """Start the camera, or the recording; ToftrackError when it cannot be."""
        if self._running:
            return
        config = self._ob.Config()
        for profile in filter(None, (self._streams.depth, self._streams.infrared)):
            config.enable_stream(profile)
        config.set_frame_aggregate_output_mode(
            self._ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE
        )
        self._waiting.clear()
        what = "the Orbbec camera was found, but cannot be started"
        if self._path is not None:
            what = f"'{self._path}' cannot be replayed"
        with reported_errors(what, _BUSY if self._path is None else _OTHER, self._errors):
            self._pipeline.start(config, self._put)
        self._running = True

    def close(self) -> None:
        """Stop the camera; a second call does nothing."""
        if not self._running:
            return
        self._running = False
        try:
            self._pipeline.stop()
        except self._errors as error:  # of a camera that is gone
            _log.warning("orbbec: %s", error)

    def __iter__(self) -> Iterator[Frame]:
        self.open()
        self.dropped = 0
        numbers, delivered = FrameNumbers(self.fps), 0
        try:
            while self._stop is None or numbers.index + 1 < self._stop:
                came = self._wait()
                if came is None:
                    break
                depth = came.get_depth_frame()
                if depth is None:
                    continue
                index = numbers.take(depth.get_index())
                self.dropped = numbers.dropped
                if index < self._start:
                    continue
                if self._stop is not None and index >= self._stop:
                    break
                delivered += 1
                yield self._frame(came, depth, index)
        finally:
            self.close()
            _log.info("orbbec: frames: %d delivered, %d dropped", delivered, self.dropped)
        if not delivered and self._path is not None:
            raise recording_index_error(self._path, numbers.index, self._start)

    def _put(self, frames: Any) -> None:
        # In a thread of the SDK's, which must not be held up: the deque drops what is too old.
        with self._came:
            self._waiting.append(frames)
            self._came.notify()

    def _wait(self) -> Any | None:
        """The next set of frames, None at a recording's end; ToftrackError when none comes."""
        deadline, over = time.monotonic() + self._timeout_s, False
        while True:
            with self._came:
                if not self._waiting:
                    self._came.wait(_SLICE_S)
                if self._waiting:
                    return self._waiting.popleft()
            if over:
                return None
            over = self._over()
            if self._path is None and not self._plugged_in():
                raise ToftrackError(
                    "the Orbbec camera was unplugged; plug it in and start again (what was done "
                    "until then is kept)"
                )
            if time.monotonic() > deadline:
                raise ToftrackError(
                    f"no frame has come from the Orbbec camera for {self._timeout_s:g} s; unplug "
                    "it and plug it in again, into a USB 3 port, or lower device.width, "
                    "device.height and device.fps"
                )

    def _over(self) -> bool:
        if self._path is None:
            return False
        return self._device.get_playback_status() == self._ob.OBPlaybackStatus.STOPPED

    def _plugged_in(self) -> bool:
        try:
            return self._serial in sdk.serials(self._ob.Context().query_devices())
        except self._errors:  # while devices come and go
            return True

    def _frame(self, came: Any, depth: Any, index: int) -> Frame:
        words = _words(depth, np.dtype("<u2"))
        infrared = None
        if self._streams.infrared is not None:
            infrared = came.get_frame(self._streams.infrared_frame)
        amplitude = None
        if infrared is not None:
            # Y8 has one byte a pixel, Y16 two.
            eight = infrared.get_format() == self._ob.OBFormat.Y8
            amplitude = _words(infrared, np.dtype("u1" if eight else "<u2")).astype(np.uint16)
        # The SDK's unit is the millimetre.
        scale_m = np.float32(1e-3 * depth.as_depth_frame().get_depth_scale())
        return Frame(
            index=index,
            timestamp_s=depth.get_timestamp_us() / 1e6,
            depth=words.astype(np.float32) * scale_m,
            amplitude=amplitude,
            radial=False,
        )


def _words(frame: Any, kind: np.dtype) -> np.ndarray:
    """(H, W) pixels of a frame of the SDK; ToftrackError when there are too few."""
    video = frame.as_video_frame()
    height, width = video.get_height(), video.get_width()
    data = np.asarray(frame.get_data(), np.uint8).ravel()
    if data.size < height * width * kind.itemsize:
        raise ToftrackError(
            f"the Orbbec camera sent {data.size} bytes for {width}x{height} pixels; plug it in "
            "again, or choose another size"
        )
    return data[: height * width * kind.itemsize].view(kind).reshape(height, width)
