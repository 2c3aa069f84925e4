"""The check of a depth image and its intrinsics where other programs hand them to the tracker."""

from __future__ import annotations

from typing import Any

import numpy as np

from toftrack.camera import Camera
from toftrack.errors import ToftrackError
from toftrack.recordings.npz import LARGEST_MEDIAN_M


def checked_image(depth_m: Any, k: Any) -> tuple[np.ndarray, np.ndarray]:
    """A depth image as (H, W) float32 metres with 0 for no reading, and (3, 3) float64 intrinsics.

    NaN, infinities and negative readings become no reading.

    Args:
        depth_m: (H, W) of any floating type, metres along the optical axis.
        k: (3, 3) pinhole matrix in pixels.

    Raises:
        ToftrackError: one of them has the wrong shape, type or unit.
    """
    try:
        depth = np.asarray(depth_m)
        matrix = np.asarray(k)
    except (TypeError, ValueError, RuntimeError) as error:  # a ragged list, a tensor on a GPU
        raise ToftrackError(
            f"the depth image and K must be NumPy arrays, or become ones ({error})"
        ) from None
    if depth.ndim != 2 or depth.size == 0:
        raise ToftrackError(
            f"the depth image must have two dimensions (rows, columns), but its shape is "
            f"{depth.shape}; give one frame at a time"
        )
    if np.issubdtype(depth.dtype, np.integer):
        raise ToftrackError(
            f"the depth image consists of whole numbers ({depth.dtype}), which looks like "
            "millimetres, but must be float metres; give depth.astype('float32') / 1000"
        )
    if not np.issubdtype(depth.dtype, np.floating):
        raise ToftrackError(f"the depth image must be float32 metres, but is {depth.dtype}")
    depth = np.ascontiguousarray(depth, np.float32)
    nearest, farthest = depth.min(), depth.max()
    if not (nearest >= 0 and farthest < np.inf):  # also true for NaN
        depth = np.where((depth > 0) & (depth < np.inf), depth, np.float32(0))
        farthest = depth.max()
    if farthest > LARGEST_MEDIAN_M:
        median = float(np.median(depth[depth > 0]))
        if median > LARGEST_MEDIAN_M:
            raise ToftrackError(
                f"the median of the depth image is {median:.0f}, which is plainly millimetres, but "
                "it must be metres; give depth / 1000"
            )
    return depth, Camera(matrix, depth.shape[1], depth.shape[0]).K
