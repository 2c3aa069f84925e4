"""What an Azure Kinect's recording says of itself: its tracks and the depth camera's lens.

k4arecorder writes Matroska (the format is described by Microsoft's "Azure Kinect file format"):
tracks titled COLOR, DEPTH and IR, depth and infrared as big-endian 16-bit words, depth in
millimetres along the optical axis, and the calibration as the attachment calibration.json. The
Orbbec Femto's recorder writes the same.

The calibration gives the lens of the whole sensor, in parts of its width and with (0, 0) at the
corner of the first pixel. A mode of the camera bins that sensor's pixels and cuts a part out.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.camera import Camera
from toftrack.errors import ToftrackError
from toftrack.json_text import parse_json

_SENSOR_PX = 1024
"""Width and height of the depth sensor."""
_MODES = {
    (320, 288): (512, (96, 90)),
    (640, 576): (1024, (192, 180)),
    (512, 512): (512, (0, 0)),
    (1024, 1024): (1024, (0, 0)),
}
"""By the image's size (narrow binned, narrow, wide binned, wide): the sensor's width after
binning, and where the image begins on it."""
_MODEL = "CALIBRATION_LensDistortionModelBrownConrady"
_CALIBRATION = "calibration.json"
_ADVICE = "give a calibrated camera with camera.file=FILE"


@dataclass(frozen=True)
class Tracks:
    """The tracks of a recording, by their numbers."""

    depth: int
    infrared: list[int]
    """None or one."""
    offset_s: float
    """Of the camera's clock at the file's time 0."""
    facts: dict[str, Any]
    """JSON-able, for the recording's metadata."""


def tracks_of(container: Any, path: Path) -> Tracks | None:
    """The tracks of an Azure Kinect's recording; None for every other video.

    Raises ToftrackError when it was recorded without depth.
    """
    named = {title: _track(container, title) for title in ("DEPTH", "IR")}
    if named["DEPTH"] is None:
        if not any(key.startswith("K4A_") for key in container.metadata):
            return None
        raise ToftrackError(
            f"'{path}' is a recording of an Azure Kinect without depth; record it with a depth "
            "mode (k4arecorder --depth-mode NFOV_UNBINNED)"
        )
    depth = container.streams[named["DEPTH"]]
    tags = {**depth.metadata, **container.metadata}
    names = {"camera": "title", "serial": "K4A_DEVICE_SERIAL_NUMBER", "mode": "K4A_DEPTH_MODE"}
    offset = tags.get("K4A_START_OFFSET_NS", "")
    return Tracks(
        depth=named["DEPTH"],
        infrared=[] if named["IR"] is None else [named["IR"]],
        offset_s=int(offset) / 1e9 if offset.isdecimal() else 0.0,
        facts={key: tags[name] for key, name in names.items() if name in tags},
    )


def camera_of(container: Any, path: Path, width: int, height: int) -> Camera:
    """The depth camera for images of that size, from the attached calibration.

    Raises ToftrackError when that is missing, damaged, or of a kind that no shipped camera has.
    """
    text = _attachment(container)
    if text is None:
        raise ToftrackError(f"'{path}' has no attachment {_CALIBRATION}; {_ADVICE}")
    if (width, height) not in _MODES:
        raise ToftrackError(
            f"'{path}' has depth images of {width}x{height} pixels, which is no mode of an Azure "
            f"Kinect; {_ADVICE}"
        )
    try:
        cameras = parse_json(text)["CalibrationInformation"]["Cameras"]
        depth = next(c for c in cameras if c["Purpose"] == "CALIBRATION_CameraPurposeDepth")
        lens, size = depth["Intrinsics"], (depth["SensorWidth"], depth["SensorHeight"])
        numbers = np.array(lens["ModelParameters"], np.float64)
        model = lens["ModelType"]
    except (ValueError, KeyError, TypeError, StopIteration):
        raise ToftrackError(f"the {_CALIBRATION} in '{path}' is damaged; {_ADVICE}") from None
    if model != _MODEL or size != (_SENSOR_PX, _SENSOR_PX) or numbers.shape != (14,):
        raise ToftrackError(
            f"the {_CALIBRATION} in '{path}' is of another kind ({model}, sensor of {size}, "
            f"{numbers.size} parameters); {_ADVICE}"
        )
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = numbers
    across, (left, top) = _MODES[width, height]
    # The sensor's (0, 0) is a pixel's corner, ours its centre.
    K = np.array(
        [[fx * across, 0, cx * across - left - 0.5], [0, fy * across, cy * across - top - 0.5]]
    )
    distortion = np.array([k1, k2, p1, p2, k3, k4, k5, k6])
    try:
        return Camera(np.vstack((K, (0, 0, 1))), width, height, distortion)
    except ToftrackError as error:
        raise ToftrackError(f"the {_CALIBRATION} in '{path}': {error}; {_ADVICE}") from None


def _track(container: Any, title: str) -> int | None:
    for stream in container.streams.video:
        if stream.metadata.get("title") == title or f"K4A_{title}_TRACK" in stream.metadata:
            return int(stream.index)
    return None


def _attachment(container: Any) -> str | None:
    for stream in container.streams:
        if stream.type == "attachment" and stream.name == _CALIBRATION:
            # As the camera stores it, the text ends with zeros.
            return bytes(stream.data).rstrip(b"\0").decode("utf-8", "replace")
    return None
