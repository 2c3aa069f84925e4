"""A RealSense camera that is none: the SDK's software device, which sees a recording.

All from the SDK's pipeline on is as with a camera. What is particular to the hardware (its modes,
its errors) is not there.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError, check_number
from toftrack.recordings.frame_store import FrameStore
from toftrack.recordings.store import open_source

_log = logging.getLogger(__name__)
FIRST_NUMBER = 1
"""Of the frames, as cameras count."""
_TURN_S = 0.005  # how soon a waiting camera notices that it may go on


@dataclass(frozen=True)
class EmulatorSettings:
    """What the virtual camera does; see conf/device/realsense.yaml."""

    source: str
    fps: float | None
    loop: bool
    unit_m: float

    def __post_init__(self) -> None:
        check_number("device.emulated.unit_m", self.unit_m, 0, above=True)
        if self.fps is not None:
            check_number("device.emulated.fps", self.fps, 0, above=True)


class EmulatedCamera:
    """The software device; `start` it when the pipeline runs, `stop` it before that ends.

    Depth images are rectified Z: the SDK's cameras know no correction of the depth.
    """

    def __init__(self, rs: ModuleType, settings: EmulatorSettings) -> None:
        self.store: FrameStore = open_source(settings.source)
        self.fps = float(settings.fps or self.store.fps)
        self.ended = threading.Event()
        """The recording is over."""
        self._rs, self._settings = rs, settings
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None
        self.device = rs.software_device()
        """Of the SDK."""
        self.device.register_info(rs.camera_info.name, "emulated")
        self.device.register_info(rs.camera_info.serial_number, "emulated-1")
        self._sensor = self.device.add_sensor("Stereo Module")
        self._sensor.add_read_only_option(rs.option.depth_units, settings.unit_m)
        self._depth = self._stream(0, rs.stream.depth, 0, rs.format.z16)
        has_amplitude = self.store.image(0)[1] is not None
        self._infrared = (
            self._stream(1, rs.stream.infrared, 1, rs.format.y16) if has_amplitude else None
        )
        self.device.create_matcher(rs.matchers.di)

    def _stream(self, uid: int, kind: Any, index: int, pixel_format: Any) -> Any:
        camera, stream = self.store.camera, self._rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fmt = kind, index, uid, pixel_format
        stream.width, stream.height, stream.bpp = camera.width, camera.height, 2
        stream.fps = max(1, round(self.fps))
        intrinsics = self._rs.intrinsics()
        intrinsics.width, intrinsics.height = camera.width, camera.height
        intrinsics.fx, intrinsics.fy = float(camera.K[0, 0]), float(camera.K[1, 1])
        intrinsics.ppx, intrinsics.ppy = float(camera.K[0, 2]), float(camera.K[1, 2])
        intrinsics.model, intrinsics.coeffs = self._rs.distortion.none, [0.0] * 5
        stream.intrinsics = intrinsics
        return self._sensor.add_video_stream(stream, True).as_video_stream_profile()

    def start(self, busy: Callable[[], bool]) -> None:
        """Begin with the first frame; hold the next one back while `busy` says so."""
        self._stopped.clear()
        self.ended.clear()
        self._thread = threading.Thread(
            target=self._run, args=(busy,), name="realsense-emulator", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self.store.close()

    def _run(self, busy: Callable[[], bool]) -> None:
        begin, number = time.monotonic(), 0
        try:
            while number < len(self.store) or self._settings.loop:
                if self._stopped.wait(max(0.0, begin + number / self.fps - time.monotonic())):
                    return
                while busy():
                    if self._stopped.wait(_TURN_S):
                        return
                self._send(number)
                number += 1
        except ToftrackError as error:  # a damaged frame: the camera falls silent
            _log.error("realsense: the emulated camera stops: %s", error)
        finally:
            self.ended.set()

    def _send(self, number: int) -> None:
        store, camera = self.store, self.store.camera
        depth, amplitude = store.image(number % len(store))
        steps = np.rint(camera.rectify(depth, store.radial) / self._settings.unit_m)
        # As with a camera, what is too far away for 16 bits is no reading.
        words = np.where(steps > np.iinfo(np.uint16).max, 0, steps).astype(np.uint16)
        self._deliver(self._depth, words, number)
        if self._infrared is not None and amplitude is not None:
            image = np.ascontiguousarray(camera.undistort_amplitude(amplitude))
            self._deliver(self._infrared, image, number)

    def _deliver(self, profile: Any, pixels: np.ndarray, number: int) -> None:
        frame = self._rs.software_video_frame()
        frame.pixels, frame.stride, frame.bpp = pixels, pixels.strides[0], pixels.itemsize
        frame.timestamp = 1e3 * number / self.fps
        frame.domain = self._rs.timestamp_domain.hardware_clock
        frame.frame_number, frame.profile = number + FIRST_NUMBER, profile
        frame.depth_units = self._settings.unit_m
        self._sensor.on_video_frame(frame)
