"""Refinement: what it takes and who does it; damped Gauss-Newton on hands in all 27 dimensions.

The filter finds the hand in few dimensions; this brings the surface onto the points that were seen,
an articulated iterative closest point (Tagliasacchi et al., "Robust articulated-ICP for real-time
hand tracking", SGP 2015) with toftrack's ellipsoids:

  * seen points are drawn to the nearest ellipsoid (point to plane along its normal);
  * the bones' axes are drawn into the silhouette where they stick out over the background;
  * the joints are drawn to keypoints, where there are any: joints that somebody else found;
  * the joint angles are drawn to those that the hypothesis began with, and are kept within the
    joint limits.

Derivatives are analytic: a joint angle moves a point X by a x (X - o), a the joint's axis and o its
origin, both columns of the kinematic chain's frames. Hypotheses are refined one after the other, by
gauss_newton_numba.py; the reference in plain torch that it is compared with is
tests/reference/refinement.py.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from toftrack.errors import check_number

JOINT_FRAME = (0, *(3 * finger + bone if bone else 0 for finger in range(5) for bone in range(4)))
"""The frame that each of the 21 joints moves with: that of the bone which ends there."""

FACING_M = 0.005
"""Seen points that lie farther than this beyond the wrist belong to the arm."""
ALONG_BONE = (0.25, 0.6, 0.9)
"""Where on a bone's axis, in parts of its length, it is compared with the silhouette."""
NEAREST_M = 0.05
"""Depth below which points are projected as if they were this far."""
SILHOUETTE_PX = 8.0
KEYPOINT_SIGMAS = 3.0
"""Robust scales: from there on a residual counts less the larger it is (Geman and McClure)."""
POINT_REACH = 0.4
"""Likewise for seen points, in parts of `Refinement.reach_m`."""


@dataclass(frozen=True)
class Refinement:
    """How an estimate is refined; the first three: conf/refine/gauss_newton.yaml.

    points: seen points that are used at most; those farther than reach_m from the surface are no
        part of the hand.
    point_m, silhouette_px, angle_rad: standard deviations of the three kinds of residual.
    damping: Levenberg's, relative to the mean diagonal of the normal matrix.
    """

    iterations: int
    point_m: float
    angle_rad: float
    points: int = 500
    reach_m: float = 0.025
    silhouette_px: float = 1.0
    damping: float = 0.001

    def __post_init__(self) -> None:
        check_number("refine.iterations", self.iterations, 0, whole=True)
        for name in ("point_m", "angle_rad"):
            check_number(f"refine.{name}", getattr(self, name), 0, above=True)


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Where the joints are, as somebody else found them.

    points_m: (21, 3) in the camera frame, the same for all hypotheses, or (N, 21, 3).
    sigma_m: (21,) or (N, 21) their standard deviations; inf where a joint was not found.
    """

    points_m: Tensor
    sigma_m: Tensor
