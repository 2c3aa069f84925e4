"""Orbbec's SDK, pyorbbecsdk2: found, asked for a camera, and its words made ours.

The package is imported only when an Orbbec camera is used: `ob` below is the imported module.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from toftrack.camera import Camera
from toftrack.devices.live import BUSY, Size, chosen_profile, chosen_serial
from toftrack.errors import ToftrackError, reported_errors

_PIXELS = ("Y16", "Z16")
"""Formats of depth: 16-bit words."""
_INFRARED = ("Y8", "Y16")


def load_sdk() -> ModuleType:
    """The module pyorbbecsdk, silenced; ToftrackError when it is not installed or cannot be loaded.

    It would write a log into the working directory, and greet on the standard output.
    """
    try:
        with _greeting_elsewhere():
            ob = importlib.import_module("pyorbbecsdk")
        missing = [name for name in ("Pipeline", "Context", "OBError") if not hasattr(ob, name)]
        if missing:
            raise ImportError(f"the installed one has no {missing[0]}")
    except ImportError as error:
        raise ToftrackError(
            f"device=orbbec needs pyorbbecsdk2 ({error}): pip install -e '.[orbbec]', or for the "
            "newest one, whose requirements others contradict, pip install --no-deps pyorbbecsdk2"
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


def errors(ob: ModuleType) -> tuple[type[Exception], ...]:
    """What the SDK raises."""
    return (RuntimeError, ob.OBError)


def find_camera(ob: ModuleType, serial: str | int | None) -> tuple[Any, str]:
    """The plugged-in camera of that serial number, the only one for None, and its number.

    Raises ToftrackError when there is none, or several and none is chosen.
    """
    with reported_errors("the Orbbec cameras cannot be listed", "plug them in again", *errors(ob)):
        devices = ob.Context().query_devices()
        numbers = serials(devices)
    number = chosen_serial(numbers, serial, "Orbbec")
    with reported_errors("the Orbbec camera was found, but cannot be opened", BUSY, *errors(ob)):
        return devices.get_device_by_index(numbers.index(number)), number


def serials(devices: Any) -> list[str]:
    """The serial numbers of a list of devices, in its order."""
    count = devices.get_count()
    return [str(devices.get_device_serial_number_by_index(index)) for index in range(count)]


@dataclass(frozen=True, eq=False)
class Streams:
    """The images that are asked of a camera: video stream profiles of the SDK."""

    depth: Any
    infrared: Any | None
    infrared_frame: Any
    """The type of the infrared frames."""


def choose_streams(
    ob: ModuleType, pipeline: Any, size: Size, infrared: bool, owner: str
) -> Streams:
    """The depth images of a camera, and infrared ones of the same size and rate.

    ob, pipeline: the SDK, and of the camera.
    size, owner: as for `chosen_profile`.
    infrared: look for infrared images, too.

    Raises ToftrackError: it has no depth images, or none of that size.
    """
    offered = _profiles(ob, pipeline, "DEPTH_SENSOR", _PIXELS)
    depth = chosen_profile(offered, _size, size, owner)
    if infrared:
        # The only infrared camera of a Femto; of a stereo camera the left one has depth's pixels.
        for name in ("IR", "LEFT_IR"):
            for profile in _profiles(ob, pipeline, f"{name}_SENSOR", _INFRARED):
                if _size(profile) == _size(depth):
                    return Streams(depth, profile, getattr(ob.OBFrameType, f"{name}_FRAME"))
    return Streams(depth, None, None)


def _profiles(ob: ModuleType, pipeline: Any, sensor: str, pixels: tuple[str, ...]) -> list[Any]:
    """The video profiles of a sensor, the camera's own proposal first; none without the sensor."""
    formats = [getattr(ob.OBFormat, name) for name in pixels]
    try:
        profiles = pipeline.get_stream_profile_list(getattr(ob.OBSensorType, sensor))
        proposed = profiles.get_default_video_stream_profile()
        listed = [profiles.get_stream_profile_by_index(i) for i in range(profiles.get_count())]
    except errors(ob):
        return []
    videos = [p.as_video_stream_profile() for p in listed if p.is_video_stream_profile()]
    return [p for p in (proposed, *videos) if p is not None and p.get_format() in formats]


def _size(profile: Any) -> tuple[int, int, int]:
    return profile.get_width(), profile.get_height(), profile.get_fps()


def camera_of(ob: ModuleType, profile: Any) -> Camera:
    """The depth camera of a stream, whose lens model the SDK shares with OpenCV.

    Raises ToftrackError for a lens that OpenCV does not have.
    """
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


def facts(device: Any) -> dict[str, str]:
    """What the camera says of itself, JSON-able."""
    info = device.get_device_info()
    return {
        "model": str(info.get_name()),
        "serial": str(info.get_serial_number()),
        "firmware": str(info.get_firmware_version()),
    }
