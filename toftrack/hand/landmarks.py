"""The 21 joints as MediaPipe's hand landmarks have them: in its order, as image coordinates."""

from __future__ import annotations

import numpy as np


def image_landmarks(joints_m: np.ndarray, k: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Joints as MediaPipe's normalised landmarks, (..., 21, 3) metres to (..., 21, 3) without unit.

    x, y: parts of the image's width and height, 0 at its left and upper edge, 1 at the others; of
    the undistorted image, and outside of 0..1 where a joint is outside of it.
    z: depth beyond the wrist's, negative where nearer to the camera, in parts of the image's width
    as a length at the wrist's distance is.
    NaN where a joint has no image.

    k: (3, 3) intrinsics in pixels, whose centres lie at whole numbers.  size_px: width, height.
    """
    joints = np.asarray(joints_m, np.float64)
    width, height = size_px
    depth = np.where(joints[..., 2] > 0, joints[..., 2], np.nan)
    u = joints[..., 0] / depth * k[0, 0] + k[0, 2]
    v = joints[..., 1] / depth * k[1, 1] + k[1, 2]
    wrist = depth[..., :1]
    beyond = (depth - wrist) / wrist * (k[0, 0] / width)
    return np.stack(((u + 0.5) / width, (v + 0.5) / height, beyond), -1)
