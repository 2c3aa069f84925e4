"""A RealSense depth camera, live or recorded, through Intel's SDK (`pip install pyrealsense2`)."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.devices.live import BUSY, OTHER_FILE, SdkCamera, Size
from toftrack.devices.realsense import sdk
from toftrack.devices.realsense.emulator import FIRST_NUMBER, EmulatedCamera, EmulatorSettings
from toftrack.errors import ToftrackError, reported_errors
from toftrack.frames import Frame

_log = logging.getLogger(__name__)
_SUFFIXES = (".bag", ".db3")
_SLICE_MS = 100  # of waiting, between looks at what else may have happened


class RealSense(SdkCamera):
    """Depth as Z along the optical axis, infrared as amplitude, by the camera's own intrinsics.

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

    kind, maker = "realsense", "RealSense"

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
        if transport not in ("usb", "emulated"):
            raise ToftrackError(f"device.transport={transport} is unknown; give usb or emulated")
        if bag is not None and transport == "emulated":
            raise ToftrackError(
                "device.bag is a recording of its own; leave out device.transport=emulated (whose "
                "recording is device.emulated.source)"
            )
        self._begin(bag, keep, queue_frames, start, stop, timeout_s)
        if self._path is not None and self._path.suffix.lower() not in _SUFFIXES:
            raise ToftrackError(
                f"'{bag}' is not a recording of a RealSense, which ends in "
                f"{' or '.join(_SUFFIXES)}; replay other recordings with device=replay "
                "device.path=FILE"
            )
        rs = self._rs = sdk.load_sdk()
        self._emulator: EmulatedCamera | None = None
        size: Size = (None, None, None)
        if self._path is not None:
            with reported_errors(
                f"{self._owner} is not a recording of a RealSense", OTHER_FILE, RuntimeError
            ):
                self._device = rs.context().load_device(str(self._path))
        elif transport == "emulated":
            self._emulator, self.first_number = EmulatedCamera(rs, emulated), FIRST_NUMBER
            self._device, self._owner = self._emulator.device, "the emulated camera"
        else:
            self._device, size = sdk.find_camera(rs, serial), (width, height, fps)
        with reported_errors(f"{self._owner} cannot be used", self._remedy, RuntimeError):
            self._streams = sdk.choose_streams(rs, self._device, size, infrared, self._owner)
            if preset is not None:
                sdk.set_preset(rs, self._streams.sensor, preset)
            own = self._streams.depth.as_video_stream_profile().get_intrinsics()
            self._set_up(
                (own.width, own.height),
                self._streams.depth.fps(),
                keep == "newest" if bag is None else bool(realtime),
                camera_file,
                lambda: sdk.camera_of(rs, own),
                transport=transport if bag is None else "recording",
                **sdk.facts(rs, self._device),
                infrared=self._streams.infrared is not None,
                preset=preset,
                realtime=bool(realtime),
            )
        self._realtime = bool(realtime)
        self._asked: Callable[[], tuple[bool, Any]] | None = None
        self._pipeline: Any = None
        self._playback: Any = None
        if self._emulator is not None:
            self._describe_emulated(self._emulator, loop=emulated.loop)

    def _describe_emulated(self, emulator: EmulatedCamera, loop: bool) -> None:
        store = emulator.store
        self.fps, self.metadata = emulator.fps, store.metadata
        self.description["fps"] = self.fps
        if loop:
            return
        stop = len(store) if self._stop is None else min(self._stop, len(store))
        self.frames = max(0, stop - self._start)
        # Only when nothing is dropped does each frame have its row.
        if store.truth is not None and self._capacity > 1:
            self.truth = store.truth[self._start : stop]

    def open(self) -> None:
        """Start the camera, or the recording; ToftrackError when it cannot be."""
        if self._pipeline is not None:
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
        with reported_errors(
            "the RealSense camera was found, but cannot be started", BUSY, RuntimeError
        ):
            pipeline.start(config, queue)
        if self._emulator is not None:
            waits = self._capacity > 1
            self._emulator.start(busy=lambda: waits and queue.size() >= self._capacity - 1)
        self._asked = functools.partial(queue.try_wait_for_frame, _SLICE_MS)
        self._pipeline = pipeline

    def _open_recording(self, pipeline: Any, config: Any) -> None:
        rs = self._rs
        with reported_errors(f"'{self._path}' cannot be replayed", OTHER_FILE, RuntimeError):
            self._playback = (
                config.resolve(rs.pipeline_wrapper(pipeline)).get_device().as_playback()
            )
            # Not at its own pace, the SDK waits for each frame to be taken.
            self._playback.set_real_time(self._realtime)
            pipeline.start(config)
        self._asked = functools.partial(pipeline.try_wait_for_frames, _SLICE_MS)
        self._pipeline = pipeline

    def close(self) -> None:
        """Stop the camera; a second call does nothing."""
        pipeline, self._pipeline = self._pipeline, None
        if pipeline is None:
            return
        if self._emulator is not None:
            self._emulator.stop()
        try:
            pipeline.stop()
        except RuntimeError as error:  # of a camera that is gone
            _log.warning("realsense: %s", error)

    def _take(self) -> Any | None:
        assert self._asked is not None
        came, frames = self._asked()
        return frames.as_frameset() if came else None

    def _over(self) -> bool:
        # The SDK would tell of a recording's end by itself, but hangs when it does so while it is
        # stopped; and it does not answer while it waits for a frame to be taken.
        if self._playback is not None:
            return self._playback.current_status() == self._rs.playback_status.stopped
        return self._emulator is not None and self._emulator.ended.is_set()

    def _plugged_in(self) -> bool:
        return bool(self._device.is_connected())

    def _number(self, depth: Any) -> int:
        return int(depth.get_frame_number())

    def _frame(self, came: Any, depth: Any, index: int) -> Frame:
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
