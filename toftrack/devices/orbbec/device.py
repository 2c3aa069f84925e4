"""An Orbbec depth camera, live or recorded, through the vendor's SDK (pyorbbecsdk2)."""

from __future__ import annotations

import logging
import threading
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.devices.live import OTHER_FILE, SdkCamera
from toftrack.devices.orbbec import sdk
from toftrack.errors import ToftrackError, reported_errors
from toftrack.frames import Frame

_log = logging.getLogger(__name__)
_SLICE_S = 0.1  # of waiting, between looks at what else may have happened


class Orbbec(SdkCamera):
    """Depth as Z along the optical axis, infrared as amplitude, by the camera's own intrinsics.

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

    kind, maker = "orbbec", "Orbbec"

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
        self._begin(bag, keep, queue_frames, start, stop, timeout_s)
        ob = self._ob = sdk.load_sdk()
        self._errors = sdk.errors(ob)
        self._serial = ""
        if self._path is not None:
            what = f"{self._owner} is not a recording of an Orbbec camera"
            with reported_errors(what, OTHER_FILE, *self._errors):
                self._device = ob.PlaybackDevice(str(self._path))
        else:
            self._device, self._serial = sdk.find_camera(ob, serial)
        with reported_errors(f"{self._owner} cannot be used", self._remedy, *self._errors):
            self._pipeline, self._running = ob.Pipeline(self._device), False
            size = width, height, fps
            self._streams = sdk.choose_streams(ob, self._pipeline, size, infrared, self._owner)
            depth = self._streams.depth
            self._set_up(
                (depth.get_width(), depth.get_height()),
                depth.get_fps() or 30.0,
                keep == "newest",
                camera_file,
                lambda: sdk.camera_of(ob, depth),
                **sdk.facts(self._device),
                infrared=self._streams.infrared is not None,
            )
        self._waiting: deque[Any] = deque(maxlen=self._capacity)
        self._came = threading.Condition()

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
        with reported_errors(what, self._remedy, *self._errors):
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

    def _put(self, frames: Any) -> None:
        # In a thread of the SDK's, which must not be held up: the deque drops what is too old.
        with self._came:
            self._waiting.append(frames)
            self._came.notify()

    def _take(self) -> Any | None:
        with self._came:
            if not self._waiting:
                self._came.wait(_SLICE_S)
            return self._waiting.popleft() if self._waiting else None

    def _over(self) -> bool:
        if self._path is None:
            return False
        return self._device.get_playback_status() == self._ob.OBPlaybackStatus.STOPPED

    def _plugged_in(self) -> bool:
        try:
            return self._serial in sdk.serials(self._ob.Context().query_devices())
        except self._errors:  # while devices come and go
            return True

    def _number(self, depth: Any) -> int:
        return int(depth.get_index())

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
