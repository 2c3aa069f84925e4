"""Where a joint may be: an ellipsoid about its estimate, with axes that anybody can work out.

The axes of joint j at p follow from the 21 joints alone, `joint_axes`:

- along the ray: the unit vector from the camera to p, so from the camera away;
- along the finger: the direction of the bone that ends at j (at the wrist: from the wrist to the
  middle finger's knuckle), less its part along the ray, normalised;
- across: the cross product of the two.

With s the standard deviations along them, the joint is in its 90 % region if the sum of
(axis . (x - p) / s)^2 is at most REGION_90 squared, the 90 % point of chi-square with three degrees
of freedom. The deviations are such that this region holds the joint in 90 % of the cases. Errors
have longer tails than a Gaussian's, so regions of other probability are not its multiples.
"""

from __future__ import annotations

import numpy as np

REGION_90 = 2.5003
"""Standard deviations to the border of the region that holds a joint with 90 %, in 3 dimensions."""
_BEFORE = np.array([9, 0, 1, 2, 3, 0, 5, 6, 7, 0, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19])
"""The joint at the other end of each joint's bone."""
_SHORT = 0.02
"""Part of the bone across the ray below which the finger points at the camera."""


def joint_axes(joints_m: np.ndarray) -> np.ndarray:
    """(..., 21, 3) joints in the camera's frame to (..., 21, 3, 3): the axes are the rows.

    Where a finger points straight at the camera, the camera's x axis stands in for its direction.
    """
    joints = np.asarray(joints_m, np.float64)
    ray = joints / np.maximum(lengths(joints), 1e-9)
    bone = joints - joints[..., _BEFORE, :]
    bone[..., 0, :] *= -1.0
    across_ray = bone - (bone * ray).sum(-1, keepdims=True) * ray
    end_on = lengths(across_ray) < _SHORT * lengths(bone) + 1e-9
    sideways = np.array([1.0, 0.0, 0.0]) - ray[..., :1] * ray
    along = np.where(end_on, sideways, across_ray)
    along /= np.maximum(lengths(along), 1e-9)
    return np.stack((ray, along, np.cross(ray, along)), -2)


def in_region_90(joints_m: np.ndarray, sigma_m: np.ndarray, true_m: np.ndarray) -> np.ndarray:
    """(..., 21) bool: the true joints lie in the 90 % regions of estimates, all (..., 21, 3).

    False where there is no region (NaN).
    """
    off = np.einsum("...ab,...b->...a", joint_axes(joints_m), true_m - joints_m) / sigma_m
    with np.errstate(invalid="ignore"):
        inside: np.ndarray = np.square(off).sum(-1) <= REGION_90**2
    return inside


def lengths(vectors: np.ndarray) -> np.ndarray:
    """(..., 3) to (..., 1); by einsum, much faster than linalg.norm on few numbers."""
    return np.sqrt(np.einsum("...a,...a->...", vectors, vectors))[..., None]
