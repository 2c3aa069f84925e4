"""An Orbbec depth camera, live or recorded, through the vendor's SDK (pyorbbecsdk2).

The package is imported only when an Orbbec camera is used: `ob` below is the imported module.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import threading
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from toftrack.devices.live import (
    BUSY,
    OTHER_FILE,
    SdkCamera,
    Size,
    chosen_profile,
    chosen_serial,
)
from toftrack.errors import ToftrackError, reported_errors
from toftrack.frames.camera import Camera
from toftrack.frames.frame import Frame

_PIXELS = ("Y16", "Z16", "RLE", "RVL", "Y14", "Y12", "Y11", "Y10")
"""Formats in which cameras send depth; of all of them the SDK makes 16-bit words."""
_INFRARED = ("Y8", "Y16")
_SLICE_S = 0.1  # of waiting, between looks at what else may have happened


class Orbbec(SdkCamera):
    """The arguments are those of conf/device/orbbec.yaml."""

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
        ob = self._ob = load_sdk()
        self.errors = (RuntimeError, ob.OBError)
        self._serial = ""
        if self._path is not None:
            what = f"{self._owner} is not a recording of an Orbbec camera"
            with reported_errors(what, OTHER_FILE, *self.errors):
                self._device = ob.PlaybackDevice(str(self._path))
        else:
            self._device, self._serial = self._found(serial)
        with reported_errors(f"{self._owner} cannot be used", self._remedy, *self.errors):
            self._pipeline = ob.Pipeline(self._device)
            self._choose_streams((width, height, fps), infrared)
            depth, info = self._depth, self._device.get_device_info()
            self._set_up(
                (depth.get_width(), depth.get_height()),
                depth.get_fps() or 30.0,
                keep == "newest",
                camera_file,
                lambda: _camera_of(ob, depth),
                model=str(info.get_name()),
                serial=str(info.get_serial_number()),
                firmware=str(info.get_firmware_version()),
                infrared=self._infrared is not None,
            )
        self._waiting: deque[Any] = deque(maxlen=self._capacity)
        self._came = threading.Condition()

    def _found(self, serial: str | int | None) -> tuple[Any, str]:
        """The plugged-in camera of that serial number, the only one for None, and its number."""
        what = "the Orbbec cameras cannot be listed"
        with reported_errors(what, "plug them in again", *self.errors):
            devices = self._ob.Context().query_devices()
            numbers = _serials(devices)
        number = chosen_serial(numbers, serial, "Orbbec")
        what = "the Orbbec camera was found, but cannot be opened"
        with reported_errors(what, BUSY, *self.errors):
            return devices.get_device_by_index(numbers.index(number)), number

    def _choose_streams(self, size: Size, infrared: bool) -> None:
        """The depth images of the camera, and infrared ones of the same size and rate."""
        offered = self._profiles("DEPTH", _PIXELS)
        self._depth = chosen_profile(offered, _size, size, self._owner)
        self._infrared, self._infrared_frame = None, None
        # The only infrared camera of a Femto; of a stereo camera the left one has depth's pixels.
        fitting = [
            (profile, getattr(self._ob.OBFrameType, f"{name}_FRAME"))
            for name in ("IR", "LEFT_IR")
            for profile in self._profiles(name, _INFRARED)
            if _size(profile) == _size(self._depth)
        ]
        if infrared and fitting:
            self._infrared, self._infrared_frame = fitting[0]

    def _profiles(self, sensor: str, pixels: tuple[str, ...]) -> list[Any]:
        """The profiles of a sensor, the camera's own proposal first; none without the sensor."""
        formats = [getattr(self._ob.OBFormat, name) for name in pixels]
        kind = getattr(self._ob.OBSensorType, f"{sensor}_SENSOR")
        try:
            profiles = self._pipeline.get_stream_profile_list(kind)
            proposed = profiles.get_default_video_stream_profile()
            listed = [profiles.get_stream_profile_by_index(i) for i in range(profiles.get_count())]
        except self.errors:
            return []
        videos = [p.as_video_stream_profile() for p in listed if p.is_video_stream_profile()]
        return [p for p in (proposed, *videos) if p is not None and p.get_format() in formats]

    def _run(self) -> None:
        config = self._ob.Config()
        for profile in filter(None, (self._depth, self._infrared)):
            config.enable_stream(profile)
        config.set_frame_aggregate_output_mode(
            self._ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE
        )
        self._waiting.clear()
        self._pipeline.start(config, self._put)

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
            return self._serial in _serials(self._ob.Context().query_devices())
        except self.errors:  # while devices come and go
            return True

    def _number(self, depth: Any) -> int:
        return int(depth.get_index())

    def _frame(self, came: Any, depth: Any, index: int) -> Frame:
        words = _words(depth, np.dtype("<u2"))
        infrared = None if self._infrared is None else came.get_frame(self._infrared_frame)
        amplitude = None
        if infrared is not None:
            # Y8 has one byte a pixel, Y16 two.
            eight = infrared.get_format() == self._ob.OBFormat.Y8
            amplitude = _words(infrared, np.dtype("u1" if eight else "<u2")).astype(np.uint16)
        # The camera's time comes with the images' metadata, and is 0 where the system has none of
        # those, as Windows before it is registered: the time of arrival is what there is.
        time_us = depth.get_timestamp_us() or depth.get_system_timestamp_us()
        # The SDK's unit is the millimetre.
        scale_m = np.float32(1e-3 * depth.as_depth_frame().get_depth_scale())
        return Frame(
            index=index,
            timestamp_s=time_us / 1e6,
            depth=words.astype(np.float32) * scale_m,
            amplitude=amplitude,
            radial=False,
        )


def load_sdk() -> ModuleType:
    """The module pyorbbecsdk, silenced: it would write a log into the working directory, and greet
    on the standard output. ToftrackError where there is none.
    """
    try:
        with _greeting_elsewhere():
            ob = importlib.import_module("pyorbbecsdk")
        missing = [name for name in ("Pipeline", "Context", "OBError") if not hasattr(ob, name)]
        if missing:
            raise ImportError(f"the installed one has no {missing[0]}")
    except ImportError as error:
        raise ToftrackError(
            f'device=orbbec needs pyorbbecsdk2 ({error}): pip install "toftrack[orbbec]", or, for '
            "the newest one, whose requirements clash with others, pip install --no-deps "
            "pyorbbecsdk2"
        ) from error
    ob.Context.set_logger_level(ob.OBLogLevel.NONE)
    return ob


@contextlib.contextmanager
def _greeting_elsewhere() -> Iterator[None]:
    """What is written to the standard output, by C++ too, goes to standard error."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        os.dup2(2, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def _serials(devices: Any) -> list[str]:
    """The serial numbers of a list of devices, in its order."""
    count = devices.get_count()
    return [str(devices.get_device_serial_number_by_index(index)) for index in range(count)]


def _size(profile: Any) -> tuple[int, int, int]:
    return profile.get_width(), profile.get_height(), profile.get_fps()


def _camera_of(ob: ModuleType, profile: Any) -> Camera:
    """The depth camera of a stream, whose lens model the SDK shares with OpenCV."""
    lens, distortion = profile.get_intrinsic(), profile.get_distortion()
    K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
    width, height = profile.get_width(), profile.get_height()
    # Before 2.1 the SDK does not tell the model, of which there was one then.
    models = ob.OBCameraDistortionModel
    model = getattr(distortion, "model", models.BROWN_CONRADY)
    radial = [getattr(distortion, f"k{number}") for number in range(1, 7)]
    coefficients = np.array([*radial[:2], distortion.p1, distortion.p2, *radial[2:]])
    if not coefficients.any() or model == models.NONE:
        return Camera(K, width, height)
    if model == getattr(models, "KANNALA_BRANDT4", None):
        return Camera(K, width, height, np.array(radial[:4]), lens="fisheye")
    if model not in (models.BROWN_CONRADY, getattr(models, "BROWN_CONRADY_K6", None)):
        raise ToftrackError(
            f"the camera's lens model, {model}, is not one of OpenCV's; give a calibrated camera "
            "with camera.file=FILE"
        )
    return Camera(K, width, height, coefficients)


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
