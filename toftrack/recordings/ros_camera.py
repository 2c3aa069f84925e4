"""The lens of a ROS camera: sensor_msgs' `CameraInfo` as a `Camera`."""

from __future__ import annotations

from typing import Any

import numpy as np

from toftrack.camera import Camera
from toftrack.errors import ToftrackError

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_BROWN = ("plumb_bob", "rational_polynomial")
"""OpenCV's model by its number of coefficients, whichever of the names is given."""


def camera_of(info: Any, rectified: bool) -> Camera:
    """The camera of depth images.

    Distortion models: `plumb_bob` and `rational_polynomial` (OpenCV's 4, 5, 8, 12 or 14
    coefficients), `equidistant` (OpenCV's fisheye), and none at all.

    info: a CameraInfo of ROS 1 (fields D, K, P) or ROS 2 (d, k, p).
    rectified: the images are free of distortion already: what they are seen through is P.

    Raises ToftrackError: it is not calibrated or of another model; the sentence begins with "it".
    """
    K = _matrix(info, "K", (3, 3))
    P = _matrix(info, "P", (3, 4))
    if rectified and P[0, 0] > 0:
        return Camera(*_window(info, np.diag([P[0, 0], P[1, 1], 1.0]), P[0, 2], P[1, 2]))
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise ToftrackError("it is not calibrated (K is zero); give one with camera.file=FILE")
    focal = np.diag([K[0, 0], K[1, 1], 1.0])
    placed = _window(info, focal, K[0, 2], K[1, 2])
    distortion = np.asarray(_field(info, "D"), np.float64).ravel()
    model = str(info.distortion_model)
    if rectified or not distortion.any() and model != "equidistant":
        return Camera(*placed)
    if model == "equidistant":
        return Camera(*placed, distortion[:4], lens="fisheye")
    if model not in _BROWN:
        raise ToftrackError(
            f"its distortion model '{model}' is none of {', '.join(_BROWN)} and equidistant; "
            "rectify the images (image_proc), or give a calibrated camera with camera.file=FILE"
        )
    return Camera(*placed, distortion)


def _window(info: Any, focal: np.ndarray, cx: float, cy: float) -> tuple[np.ndarray, int, int]:
    """K, columns and rows of the image that is sent: a part of the sensor's, and binned."""
    roi, bins = info.roi, np.maximum(1, (int(info.binning_x), int(info.binning_y)))
    size = np.array((roi.width or info.width, roi.height or info.height), np.int64) // bins
    K = focal.copy()
    K[0, 0], K[1, 1] = focal[[0, 1], [0, 1]] / bins
    # As image_geometry has it, without the half pixel by which a bin's centre lies elsewhere.
    K[:2, 2] = np.array((cx - roi.x_offset, cy - roi.y_offset)) / bins
    return K, int(size[0]), int(size[1])


def _matrix(info: Any, name: str, shape: tuple[int, int]) -> np.ndarray:
    return np.asarray(_field(info, name), np.float64).reshape(shape)


def _field(info: Any, name: str) -> Any:
    """A field that ROS 1 writes with a capital letter and ROS 2 with a small one."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.lower())
