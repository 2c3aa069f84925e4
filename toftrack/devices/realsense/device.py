"""A RealSense depth camera, live or recorded, through Intel's SDK (`pip install pyrealsense2`)."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.camera import Camera
from toftrack.devices.base import BaseDevice
from toftrack.devices.live import FrameNumbers, check_live, recording_index_error, reported_errors
from toftrack.devices.realsense import sdk
from toftrack.devices.realsense.emulator import FIRST_NUMBER, EmulatedCamera, EmulatorSettings
from toftrack.errors import ToftrackError
from toftrack.frames import Frame

_log = logging.getLogger(__name__)
_SUFFIXES = (".bag", ".db3")
_SLICE_MS = 100  # of waiting, between looks at what else may have happened
_BUSY = (
    "close other programs that use it, plug it in again, into a USB 3 port, and on Linux install "
    "its udev rules"
)


class RealSense(BaseDevice):
    """Depth as Z along the optical axis, infrared as amplitude, by the camera's own intrinsics.

    The index is the camera's frame number, counted from the first frame; what was dropped leaves a
    gap. Leaving the iteration stops the camera, another iteration starts it again.

    Args:
        transport: `usb`, or `emulated` (the SDK's software device, which sees a recording).
        bag: a recording of the SDK (`.bag`, `.db3`) instead of a camera.
        serial: which camera; None = the only one.
        width, height, fps: of a live camera's images.
        infrared: deliver infrared images of the same size as amplitude, where there are any.
        preset: of the camera, by name, as `hand` or `high_accuracy`; None = as it is.
        keep: `newest` delivers the newest frame and drops older ones that nobody has taken;
            `every` lets up to `queue_frames` wait. A recording delivers all unless `realtime`.
        queue_frames: see `keep`.
        start: first frame; the ones before are left out.
        stop: end before this index; None = go on.
        timeout_s: so long without a frame means that the camera does not answer.
        realtime: replay a recording at its own pace, dropping what comes too late.
        camera_file: a calibrated camera instead of the camera's own intrinsics.
        emulated: settings of the virtual camera.

    Raises:
        ToftrackError: a setting makes no sense, pyrealsense2 is not installed, there is no camera,
            the recording cannot be used, or there are no depth images of that size.
    """

    def __init__(
        self,
        transport: str,
        bag: str | Path | None,
        serial: str | int | None,
        width: int,
        height: int,
        fps: int,
        infrared: bool,
        preset: str | None,
        keep: str,
        queue_frames: int,
        start: int,
        stop: int | None,
        timeout_s: float,
        realtime: bool,
        camera_file: str | Path | None,
        emulated: EmulatorSettings,
    ) -> None:
        _check(transport, bag, keep, queue_frames, start, stop, timeout_s)
        path = None if bag is None else _recording(bag)
        rs = self._rs = sdk.load_sdk()
        self._emulator: EmulatedCamera | None = None
        size = None
        if path is not None:
            with reported_errors(
                f"'{bag}' is not a recording of a RealSense", "choose another file"
            ):
                device, owner = rs.context().load_device(str(path)), f"'{bag}'"
        elif transport == "emulated":
            self._emulator = EmulatedCamera(rs, emulated)
            device, owner = self._emulator.device, "the emulated camera"
        else:
            device = sdk.find_camera(rs, None if serial is None else str(serial))
            size, owner = (width, height, fps), "the camera"
        with reported_errors(
            f"{owner} cannot be used", _BUSY if path is None else "choose another file"
        ):
            self._streams = sdk.choose_streams(rs, device, size, infrared, owner)
            if preset is not None:
                sdk.set_preset(rs, self._streams.sensor, preset)
            own = self._streams.depth.as_video_stream_profile().get_intrinsics()
            about = sdk.facts(rs, device)
        if camera_file is None:
            camera = sdk.camera_of(rs, own)
        else:
            camera = Camera.load_for(camera_file, own.width, own.height, owner)
        newest = bool(realtime) if path is not None else keep == "newest"
        super().__init__(camera, self._streams.depth.fps(), live=newest)
        self._device, self._path, self._realtime = device, path, bool(realtime)
        self._capacity = queue_frames if keep == "every" else 1
        self._start, self._stop, self._timeout_s = start, stop, timeout_s
        self._take: Callable[[], Any] | None = None
        self._close: Callable[[], None] | None = None
        self._playback: Any = None
        if path is None and stop is not None:
            self.frames = stop - start
        if self._emulator is not None:
            self._describe_emulated(self._emulator, loop=emulated.loop)
        self.description = {
            "device": "realsense",
            "transport": transport if path is None else "recording",
            "recording": None if bag is None else str(bag),
            **about,
            "size": [own.width, own.height],
            "fps": self.fps,
            "infrared": self._streams.infrared is not None,
            "preset": preset,
            "keep": keep,
            "realtime": self._realtime,
            "start": start,
            "stop": stop,
            "camera_file": None if camera_file is None else str(camera_file),
        }

    def _describe_emulated(self, emulator: EmulatedCamera, loop: bool) -> None:
        store = emulator.store
        self.fps, self.metadata = emulator.fps, store.metadata
        if loop:
            return
        stop = len(store) if self._stop is None else min(self._stop, len(store))
        self.frames = max(0, stop - self._start)
        # Only when nothing is dropped does each frame have its row.
        if store.truth is not None and self._capacity > 1:
            self.truth = store.truth[self._start : stop]

    def open(self) -> None:
        """Start the camera, or the recording; ToftrackError when it cannot be."""
        if self._take is not None:
            return
        rs, config = self._rs, self._rs.config()
        pipeline = rs.pipeline()
        if self._path is None:
            pipeline.set_device(self._device)
        else:
            config.enable_device_from_file(str(self._path), False)
        for profile in filter(None, (self._streams.depth, self._streams.infrared)):
            video = profile.as_video_stream_profile()
            config.enable_stream(
                profile.stream_type(),
                profile.stream_index(),
                video.width(),
                video.height(),
                profile.format(),
                profile.fps(),
            )
        if self._path is None:
            self._open_camera(pipeline, config)
        else:
            self._open_recording(pipeline, config)

    def _open_camera(self, pipeline: Any, config: Any) -> None:
        # The frames are kept, so that waiting ones do not use up the few that the SDK has.
        queue = self._rs.frame_queue(self._capacity, True)
        with reported_errors("the RealSense camera was found, but cannot be started", _BUSY):
            pipeline.start(config, queue)
        emulator = self._emulator
        if emulator is not None:
            waits = self._capacity > 1
            emulator.start(busy=lambda: waits and queue.size() >= self._capacity - 1)
        self._take = functools.partial(queue.try_wait_for_frame, _SLICE_MS)
        self._close = functools.partial(_stop_camera, pipeline, emulator)

    def _open_recording(self, pipeline: Any, config: Any) -> None:
        rs = self._rs
        with reported_errors(f"'{self._path}' cannot be replayed", "choose another file"):
            playback = config.resolve(rs.pipeline_wrapper(pipeline)).get_device().as_playback()
            # Not at its own pace, the SDK waits for each frame to be taken.
            playback.set_real_time(self._realtime)
            pipeline.start(config)
        self._take = functools.partial(pipeline.try_wait_for_frames, _SLICE_MS)
        self._playback = playback
        self._close = functools.partial(_stop_camera, pipeline, None)

    def close(self) -> None:
        """Stop the camera; a second call does nothing."""
        self._take, close, self._close = None, self._close, None
        if close is not None:
            close()

    def __iter__(self) -> Iterator[Frame]:
        self.open()
        self.dropped = 0
        numbers = FrameNumbers(self.fps, None if self._emulator is None else FIRST_NUMBER)
        delivered, begun = 0, False
        try:
            while self._stop is None or numbers.index + 1 < self._stop:
                came = self._wait(begun)
                if came is None:
                    break
                depth = came.get_depth_frame()
                if not depth:
                    continue
                begun = True
                index = numbers.take(depth.get_frame_number())
                self.dropped = numbers.dropped
                if index < self._start:
                    continue
                if self._stop is not None and index >= self._stop:
                    break
                delivered += 1
                yield _frame(came, depth, index)
        finally:
            self.close()
            _log.info("realsense: frames: %d delivered, %d dropped", delivered, self.dropped)
        if not delivered and self._path is not None:
            raise recording_index_error(self._path, numbers.index, self._start)

    def _wait(self, begun: bool) -> Any | None:
        """The next set of frames, None at the end; ToftrackError when none comes."""
        deadline, over = time.monotonic() + self._timeout_s, False
        assert self._take is not None
        while True:
            came, frames = self._take()
            if came:
                return frames.as_frameset()
            if over:
                return None
            over = begun and self._over()  # a recording that has not begun is stopped, too
            if self._path is None and not self._device.is_connected():
                raise ToftrackError(
                    "the RealSense camera was unplugged; plug it in and start again (what was done "
                    "until then is kept)"
                )
            if time.monotonic() > deadline:
                raise ToftrackError(
                    f"no frame has come from the RealSense for {self._timeout_s:g} s; unplug the "
                    "camera and plug it in again, into a USB 3 port, or lower device.width, "
                    "device.height and device.fps"
                )

    def _over(self) -> bool:
        """No more frames will come; to be asked only when none is there.

        The SDK would tell of a recording's end by itself, but hangs when it does so while it is
        stopped; and it does not answer while it waits for a frame to be taken.
        """
        if self._playback is not None:
            return self._playback.current_status() == self._rs.playback_status.stopped
        return self._emulator is not None and self._emulator.ended.is_set()


def _frame(came: Any, depth: Any, index: int) -> Frame:
    # Copies: the SDK uses its memory again.
    words = np.asanyarray(depth.get_data())
    infrared = came.get_infrared_frame()
    return Frame(
        index=index,
        timestamp_s=depth.get_timestamp() / 1e3,
        depth=words.astype(np.float32) * np.float32(depth.as_depth_frame().get_units()),
        amplitude=np.asanyarray(infrared.get_data()).astype(np.uint16) if infrared else None,
        radial=False,
    )


def _stop_camera(pipeline: Any, emulator: EmulatedCamera | None) -> None:
    if emulator is not None:
        emulator.stop()
    try:
        pipeline.stop()
    except RuntimeError as error:  # of a camera that is gone
        _log.warning("realsense: %s", error)


def _check(
    transport: str,
    bag: str | Path | None,
    keep: str,
    queue_frames: int,
    start: int,
    stop: int | None,
    timeout_s: float,
) -> None:
    if transport not in ("usb", "emulated"):
        raise ToftrackError(f"device.transport={transport} is unknown; give usb or emulated")
    if bag is not None and transport == "emulated":
        raise ToftrackError(
            "device.bag is a recording of its own; leave out device.transport=emulated (whose "
            "recording is device.emulated.source)"
        )
    check_live("realsense", keep, queue_frames, start, stop, timeout_s)


def _recording(path: str | Path) -> Path:
    full = Path(path).expanduser()
    if not full.is_file():
        raise ToftrackError(f"there is no file '{path}'; give a recording with device.bag=FILE")
    if full.suffix.lower() not in _SUFFIXES:
        raise ToftrackError(
            f"'{path}' is not a recording of a RealSense, which ends in {' or '.join(_SUFFIXES)}; "
            "replay other recordings with device=replay device.path=FILE"
        )
    return full
