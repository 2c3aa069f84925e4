"""Videos of depth for the tests: an Azure Kinect's recording, and lossless grey ones."""

import json
import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

FPS = 25
START_OFFSET_S = 0.5
"""Of the camera's clock in `write_kinect`."""
RATIONAL = (0.55, -0.02, 1e-3, -2e-3, -0.0027, 0.89, 0.086, -0.014)
"""OpenCV's k1 k2 p1 p2 k3 k4 k5 k6, of the size that an Azure Kinect's have."""


def calibration(K: np.ndarray, across: int, corner: tuple[int, int], lens: Any = RATIONAL) -> dict:
    """calibration.json of a camera whose mode bins the sensor to `across` pixels and cuts there.

    K: (3, 3) of the mode's images, (0, 0) at the first pixel's centre.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = lens
    centre = (K[:2, 2] + 0.5 + corner) / across
    parameters = [*centre, K[0, 0] / across, K[1, 1] / across]
    parameters += [k1, k2, k3, k4, k5, k6, 0, 0, p2, p1]
    camera = {
        "Intrinsics": {
            "ModelParameterCount": 14,
            "ModelParameters": [float(number) for number in parameters],
            "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
        },
        "Purpose": "CALIBRATION_CameraPurposeDepth",
        "SensorWidth": 1024,
        "SensorHeight": 1024,
    }
    colour = {"Purpose": "CALIBRATION_CameraPurposePhotoVideo"}
    return {"CalibrationInformation": {"Cameras": [colour, camera]}}


def write_kinect(
    path: Path,
    depth_mm: np.ndarray,
    infrared: np.ndarray | None = None,
    about: dict | bytes | None = None,
) -> Path:
    """(T, H, W) uint16 images as k4arecorder writes them; `about` becomes calibration.json."""
    container = av.open(str(path), "w", options={"allow_raw_vfw": "1"})
    container.metadata.update(
        {
            "title": "Azure Kinect",
            "K4A_START_OFFSET_NS": str(round(START_OFFSET_S * 1e9)),
            "K4A_DEVICE_SERIAL_NUMBER": "0042",
        }
    )
    images = [depth_mm] if infrared is None else [depth_mm, infrared]
    streams = [_grey(container, "rawvideo", "gray16be", each.shape) for each in images]
    for stream, title in zip(streams, ("DEPTH", "IR"), strict=False):
        stream.metadata["title"] = title
    if about is not None:
        text = about if isinstance(about, bytes) else json.dumps(about).encode() + b"\0\0"
        container.add_attachment("calibration.json", "application/octet-stream", text)
    _encode(container, streams, images)
    # The muxer has forgotten which kind of raw images they are, and turns them upside down.
    height, width = depth_mm.shape[1:]
    wrong = struct.pack("<IiiHHI", 40, width, -height, 1, 16, 0)
    right = struct.pack("<IiiHH4s", 40, width, height, 1, 16, b"b16g")
    content = path.read_bytes()
    assert content.count(wrong) == len(streams)
    path.write_bytes(content.replace(wrong, right))
    return path


def write_grey(
    path: Path, words: np.ndarray, codec: str = "ffv1", pixels: str = "gray16le"
) -> Path:
    """(T, H, W) uint16 images as a lossless grey video."""
    container = av.open(str(path), "w")
    _encode(container, [_grey(container, codec, pixels, words.shape)], [words])
    return path


def _grey(container: Any, codec: str, pixels: str, shape: tuple[int, ...]) -> Any:
    stream = container.add_stream(codec, rate=FPS)
    stream.height, stream.width = shape[1:]
    stream.pix_fmt = pixels
    return stream


def _encode(container: Any, streams: list[Any], images: list[np.ndarray]) -> None:
    for number, together in enumerate(zip(*images, strict=True)):
        for stream, image in zip(streams, together, strict=True):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), stream.pix_fmt)
            frame.pts, frame.time_base = number, Fraction(1, FPS)
            container.mux(stream.encode(frame))
    for stream in streams:
        container.mux(stream.encode())
    container.close()


def video_frames(path: Path) -> list[np.ndarray]:
    """All frames of a video, BGR."""
    reader, frames = cv2.VideoCapture(str(path)), []
    while True:
        there, frame = reader.read()
        if not there:
            return frames
        frames.append(frame)
