"""A camera as arrays of an `.npz` recording, and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from toftrack.camera import Camera
from toftrack.errors import ToftrackError

CAMERA_KEYS = ("K", "distortion", "lens", "depth_polynomial", "depth_polynomial_range_m")
_POLYNOMIAL = CAMERA_KEYS[3:]


def camera_arrays(camera: Camera) -> dict[str, np.ndarray]:
    """Its arrays by key; those of what most cameras do not have only where this one does."""
    arrays = {"K": np.asarray(camera.K), "distortion": np.asarray(camera.distortion)}
    if camera.lens != "opencv":
        arrays["lens"] = np.array(camera.lens)
    for key in _POLYNOMIAL:
        if values := getattr(camera, key):
            arrays[key] = np.array(values)
    return arrays


def camera_of(arrays: dict[str, Any], width: int, height: int) -> Camera:
    """The camera of images of that size, px; `K` must be there. Raises ToftrackError."""
    lens = arrays.get("lens", np.array("opencv"))
    if lens.size != 1 or lens.dtype.kind != "U":
        raise ToftrackError("'lens' must be one text, opencv or fisheye")
    return Camera(
        arrays["K"],
        width,
        height,
        arrays.get("distortion", np.zeros(5)),
        lens=lens.reshape(()).item(),
        **{key: arrays[key] for key in _POLYNOMIAL if key in arrays},
    )
