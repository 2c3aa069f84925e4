"""Intel's RealSense SDK, pyrealsense2: found, asked for a camera, and its words made ours.

The package is imported only when a RealSense camera is used: `rs` below is the imported module.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from toftrack.camera import Camera
from toftrack.devices.live import Size, chosen_profile, chosen_serial
from toftrack.errors import ToftrackError, reported_errors

_WORST_FIT_PX = 0.5


def load_sdk() -> ModuleType:
    """The module pyrealsense2; ToftrackError when it is not installed or cannot be loaded."""
    try:
        return _imported()
    except ImportError as error:
        if "libusb" in str(error):
            with contextlib.suppress(ImportError, OSError):
                _preload_libusb()
                return _imported()
            raise ToftrackError(
                "pyrealsense2 needs libusb-1.0, which is not installed: pip install "
                "-e '.[realsense]' brings one, as does apt install libusb-1.0-0"
            ) from error
        raise ToftrackError(
            f"device=realsense needs pyrealsense2 ({error}): pip install -e '.[realsense]'"
        ) from error


def _imported() -> ModuleType:
    rs = importlib.import_module("pyrealsense2")
    if not hasattr(rs, "pipeline") or not hasattr(rs.pipeline, "set_device"):
        raise ImportError("the installed one is older than 2.56 or incomplete")
    return rs


def _preload_libusb() -> None:
    # The wheels of pyrealsense2 leave libusb to the system; a loaded one of that name serves, too.
    path = importlib.import_module("libusb_package").get_library_path()
    ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)


def find_camera(rs: ModuleType, serial: str | int | None) -> Any:
    """The plugged-in camera of that serial number, the only one for None; else ToftrackError."""
    with reported_errors(
        "the RealSense cameras cannot be listed", "unplug them and plug them in again", RuntimeError
    ):
        found = {_info(rs, device, "serial_number"): device for device in rs.context().devices}
    otherwise = ", or try it without a camera with device.transport=emulated"
    return found[chosen_serial(list(found), serial, "RealSense", otherwise)]


def facts(rs: ModuleType, device: Any) -> dict[str, Any]:
    """What the camera says of itself, JSON-able."""
    names = {"model": "name", "serial": "serial_number", "firmware": "firmware_version"}
    return {key: _info(rs, device, name) for key, name in names.items()}


def _info(rs: ModuleType, device: Any, name: str) -> str:
    info = getattr(rs.camera_info, name)
    return str(device.get_info(info)) if device.supports(info) else "unknown"


@dataclass(frozen=True, eq=False)
class Streams:
    """The images that are asked of a camera: stream profiles of the SDK."""

    sensor: Any
    """The sensor that delivers them."""
    depth: Any
    infrared: Any | None


def choose_streams(rs: ModuleType, device: Any, size: Size, infrared: bool, owner: str) -> Streams:
    """The depth images of a device, and the infrared ones that lie on the same pixels.

    rs, device: of the SDK.
    size, owner: as for `chosen_profile`.
    infrared: look for infrared images, too.

    Raises ToftrackError: it has no depth images, or none of that size.
    """
    sensor, profiles, offered = None, [], []
    for sensor in device.query_sensors():
        profiles = [p for p in sensor.get_stream_profiles() if p.is_video_stream_profile()]
        if offered := _of_kind(profiles, rs.stream.depth, rs.format.z16):
            break
    depth = chosen_profile(offered, _size, size, owner)
    return Streams(sensor, depth, _infrared(rs, profiles, depth) if infrared else None)


def _of_kind(profiles: list[Any], kind: Any, pixels: Any) -> list[Any]:
    return [p for p in profiles if p.stream_type() == kind and p.format() == pixels]


def _size(profile: Any) -> tuple[int, int, int]:
    video = profile.as_video_stream_profile()
    return video.width(), video.height(), profile.fps()


def _infrared(rs: ModuleType, profiles: list[Any], depth: Any) -> Any | None:
    # 8 bits first: the 16-bit images of stereo cameras are for calibration and not rectified. The
    # left camera (number 1) first: the depth images lie on its pixels.
    for wanted in (rs.format.y8, rs.format.y16):
        fitting = [
            p
            for p in _of_kind(profiles, rs.stream.infrared, wanted)
            if _size(p) == _size(depth) and p.stream_index() < 2
        ]
        if fitting:
            return fitting[0]
    return None


def camera_of(rs: ModuleType, intrinsics: Any) -> Camera:
    """A stream's intrinsics as a `Camera`.

    OpenCV's distortion goes from the ideal to the measured pixel, as the SDK's own projection does.
    Its Brown-Conrady model is OpenCV's; the modified and the inverse one differ in the tangential
    part, so the coefficients are those that fit the SDK's projection best.

    Raises:
        ToftrackError: no coefficients fit within half a pixel.
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
    """Choose one of the camera's own presets by its name, as `hand` or `high_accuracy`.

    Raises ToftrackError, with the names there are, for another one.
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
