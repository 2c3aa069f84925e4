"""A RealSense depth camera, live or recorded, through Intel's SDK (`pip install pyrealsense2`).

The package is imported only when a RealSense camera is used: `rs` below is the imported module.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from toftrack.devices.live import OTHER_FILE, SdkCamera, Size, chosen_profile, chosen_serial
from toftrack.devices.realsense.emulator import FIRST_NUMBER, EmulatedCamera, EmulatorSettings
from toftrack.errors import ToftrackError, check_choice, reported_errors
from toftrack.frames.camera import Camera
from toftrack.frames.frame import Frame

_SUFFIXES = (".bag", ".db3")
_SLICE_MS = 100  # of waiting, between looks at what else may have happened
_WORST_FIT_PX = 0.5
_ROS_TOPICS = "; a bag of ROS topics goes without: toftrack track FILE"


class RealSense(SdkCamera):
    """The arguments are those of conf/device/realsense.yaml."""

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
        check_choice("device.transport", transport, ("usb", "emulated"))
        if bag is not None and transport == "emulated":
            raise ToftrackError(
                "device.bag already gives the frames; leave out device.transport=emulated (whose "
                "recording is device.emulated.source)"
            )
        self._begin(bag, keep, queue_frames, start, stop, timeout_s)
        if self._path is not None and self._path.suffix.lower() not in _SUFFIXES:
            raise ToftrackError(
                f"'{bag}' is not a recording of a RealSense, which ends in "
                f"{' or '.join(_SUFFIXES)}; replay other recordings with device=replay "
                "device.path=FILE"
            )
        rs = self._rs = load_sdk(_ROS_TOPICS if bag is not None else "")
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
            self._device, size = _found(rs, serial), (width, height, fps)
        with reported_errors(f"{self._owner} cannot be used", self._remedy, RuntimeError):
            chosen = choose_streams(rs, self._device, size, infrared, self._owner)
            sensor, self._depth, self._infrared = chosen
            if not self._depth.fps():  # which the SDK says of a bag of ROS 2
                raise ToftrackError(f"{self._owner} is a bag of ROS topics; {OTHER_FILE}")
            if preset is not None:
                set_preset(rs, sensor, preset)
            own = self._depth.as_video_stream_profile().get_intrinsics()
            self._set_up(
                (own.width, own.height),
                self._depth.fps(),
                keep == "newest" if bag is None else bool(realtime),
                camera_file,
                lambda: camera_of(rs, own),
                transport=transport if bag is None else "recording",
                model=_info(rs, self._device, "name"),
                serial=_info(rs, self._device, "serial_number"),
                firmware=_info(rs, self._device, "firmware_version"),
                infrared=self._infrared is not None,
                preset=preset,
                realtime=bool(realtime),
            )
        self._realtime = bool(realtime)
        self._asked: Callable[[], tuple[bool, Any]]
        self._playback: Any = None
        if self._emulator is None:
            return
        store = self._emulator.store
        self.fps, self.metadata = self._emulator.fps, store.metadata
        self.description["fps"] = self.fps
        if not emulated.loop:
            stop = len(store) if self._stop is None else min(self._stop, len(store))
            self.frames = max(0, stop - self._start)
            # Only when nothing is dropped does each frame have its row.
            if store.truth is not None and self._capacity > 1:
                self.truth = store.truth[self._start : stop]

    def _run(self) -> None:
        rs, config = self._rs, self._rs.config()
        pipeline = self._pipeline = rs.pipeline()
        if self._path is None:
            pipeline.set_device(self._device)
        else:
            config.enable_device_from_file(str(self._path), False)
        for profile in filter(None, (self._depth, self._infrared)):
            config.enable_stream(
                profile.stream_type(),
                profile.stream_index(),
                *_size(profile)[:2],
                profile.format(),
                profile.fps(),
            )
        if self._path is not None:
            resolved = config.resolve(rs.pipeline_wrapper(pipeline))
            self._playback = resolved.get_device().as_playback()
            # Not at its own pace, the SDK waits for each frame to be taken.
            self._playback.set_real_time(self._realtime)
            pipeline.start(config)
            self._asked = functools.partial(pipeline.try_wait_for_frames, _SLICE_MS)
            return
        # The frames are kept, so that waiting ones do not use up the few that the SDK has.
        queue = rs.frame_queue(self._capacity, True)
        pipeline.start(config, queue)
        if self._emulator is not None:
            waits = self._capacity > 1
            self._emulator.start(busy=lambda: waits and queue.size() >= self._capacity - 1)
        self._asked = functools.partial(queue.try_wait_for_frame, _SLICE_MS)

    def close(self) -> None:
        """Stop the camera; a second call does nothing."""
        if self._running and self._emulator is not None:
            self._emulator.stop()
        super().close()

    def _take(self) -> Any | None:
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


def load_sdk(otherwise: str = "") -> ModuleType:
    """The module pyrealsense2; ToftrackError, with what to do `otherwise`, where there is none."""
    try:
        return _imported()
    except ImportError as error:
        if "libusb" in str(error):
            # The wheels leave libusb to the system; a loaded one of that name serves, too.
            with contextlib.suppress(ImportError, OSError):
                path = importlib.import_module("libusb_package").get_library_path()
                ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
                return _imported()
            raise ToftrackError(
                "pyrealsense2 needs libusb-1.0, which is not installed: pip install "
                '"toftrack[realsense]" brings one, as does apt install libusb-1.0-0'
            ) from error
        raise ToftrackError(
            f'device=realsense needs pyrealsense2 ({error}): pip install "toftrack[realsense]"'
            f"{otherwise}"
        ) from error


def _imported() -> ModuleType:
    rs = importlib.import_module("pyrealsense2")
    if not hasattr(rs, "pipeline") or not hasattr(rs.pipeline, "set_device"):
        raise ImportError("the installed one is older than 2.56 or incomplete")
    return rs


def _found(rs: ModuleType, serial: str | int | None) -> Any:
    """The plugged-in camera of that serial number, the only one for None; else ToftrackError."""
    with reported_errors(
        "the RealSense cameras cannot be listed", "unplug them and plug them in again", RuntimeError
    ):
        found = {_info(rs, device, "serial_number"): device for device in rs.context().devices}
    otherwise = ", or try it without a camera with device.transport=emulated"
    return found[chosen_serial(list(found), serial, "RealSense", otherwise)]


def _info(rs: ModuleType, device: Any, name: str) -> str:
    info = getattr(rs.camera_info, name)
    return str(device.get_info(info)) if device.supports(info) else "unknown"


def choose_streams(
    rs: ModuleType, device: Any, size: Size, infrared: bool, owner: str
) -> tuple[Any, Any, Any | None]:
    """A device's depth sensor, and the profiles of its depth images and, if asked for and there, of
    the infrared images on the same pixels.  size, owner: as for `chosen_profile`.
    """
    sensor, profiles, offered = None, [], []
    for sensor in device.query_sensors():
        profiles = [p for p in sensor.get_stream_profiles() if p.is_video_stream_profile()]
        if offered := _of_kind(profiles, rs.stream.depth, rs.format.z16):
            break
    depth = chosen_profile(offered, _size, size, owner)
    return sensor, depth, _infrared_of(rs, profiles, depth) if infrared else None


def _of_kind(profiles: list[Any], kind: Any, pixels: Any) -> list[Any]:
    return [p for p in profiles if p.stream_type() == kind and p.format() == pixels]


def _size(profile: Any) -> tuple[int, int, int]:
    video = profile.as_video_stream_profile()
    return video.width(), video.height(), profile.fps()


def _infrared_of(rs: ModuleType, profiles: list[Any], depth: Any) -> Any | None:
    # 8 bits first: the 16-bit images of stereo cameras are for calibration and not rectified. The
    # left camera (number 1) first: the depth images lie on its pixels.
    fitting = (
        p
        for wanted in (rs.format.y8, rs.format.y16)
        for p in _of_kind(profiles, rs.stream.infrared, wanted)
        if _size(p) == _size(depth) and p.stream_index() < 2
    )
    return next(fitting, None)


def camera_of(rs: ModuleType, intrinsics: Any) -> Camera:
    """A stream's intrinsics as a `Camera`.

    OpenCV's distortion goes from the ideal to the measured pixel, as the SDK's own projection does.
    Its Brown-Conrady model is OpenCV's; the modified and the inverse one differ in the tangential
    part, so the coefficients are those that fit the SDK's projection best. ToftrackError where no
    coefficients fit within half a pixel.
    """
    K = np.array(
        [[intrinsics.fx, 0, intrinsics.ppx], [0, intrinsics.fy, intrinsics.ppy], [0, 0, 1.0]]
    )
    width, height = intrinsics.width, intrinsics.height
    if not np.any(intrinsics.coeffs) or intrinsics.model == rs.distortion.none:
        return Camera(K, width, height)
    u, v = np.meshgrid(np.linspace(0, width - 1, 25), np.linspace(0, height - 1, 19))
    x, y = (u.ravel() - K[0, 2]) / K[0, 0], (v.ravel() - K[1, 2]) / K[1, 1]
    seen = [
        rs.rs2_project_point_to_pixel(intrinsics, [a, b, 1.0]) for a, b in zip(x, y, strict=True)
    ]
    shift = np.array(seen) - np.stack((K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]), axis=1)
    # OpenCV's model is linear in its coefficients k1 k2 p1 p2 k3.
    r2 = x * x + y * y
    along_u = np.stack((x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3), axis=1)
    along_v = np.stack((y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3), axis=1)
    design = np.concatenate((K[0, 0] * along_u, K[1, 1] * along_v))
    target = np.concatenate((shift[:, 0], shift[:, 1]))
    distortion = np.linalg.lstsq(design, target, rcond=None)[0]
    worst = float(np.abs(design @ distortion - target).max())
    if not worst <= _WORST_FIT_PX:
        raise ToftrackError(
            f"the camera's lens model, {intrinsics.model}, is not one of OpenCV's (off by "
            f"{worst:.1f} pixels); give a calibrated camera with camera.file=FILE"
        )
    return Camera(K, width, height, distortion)


def set_preset(rs: ModuleType, sensor: Any, name: str) -> None:
    """Choose one of the camera's own presets by its name, as `hand` or `high_accuracy`;
    ToftrackError, with the names there are, for another one.
    """
    option, names = rs.option.visual_preset, {}
    if sensor.supports(option):
        limits = sensor.get_option_range(option)
        for value in range(round(limits.min), round(limits.max) + 1):
            text = sensor.get_option_value_description(option, value)
            if text:
                names[text.lower().replace(" ", "_")] = value
    if name.lower() not in names:
        raise ToftrackError(
            f"the camera has no preset {name}; set device.preset to one of "
            f"{', '.join(['null', *names])}"
        )
    with reported_errors(
        f"the camera does not take the preset {name}", "set device.preset=null", RuntimeError
    ):
        sensor.set_option(option, names[name.lower()])
