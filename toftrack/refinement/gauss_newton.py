"""Refinement: damped Gauss-Newton on hands in all 27 dimensions after the filter.

The filter finds the hand in few dimensions; this brings the surface onto the points that were seen,
an articulated iterative closest point (Tagliasacchi et al., "Robust articulated-ICP for real-time
hand tracking", SGP 2015) with toftrack's ellipsoids:

  * seen points are drawn to the nearest ellipsoid (point to plane along its normal);
  * the bones' axes are drawn into the silhouette where they stick out over the background;
  * the joints are drawn to keypoints, where there are any: joints that somebody else found;
  * the joint angles are drawn to the filter's estimate, the pose space acting as a prior, and are
    kept within the joint limits.

Derivatives are analytic: a joint angle moves a point X by a x (X - o), a the joint's axis and o its
origin, both columns of the kinematic chain's frames. Many hypotheses are refined side by side; this
is the reference in plain torch, and gauss_newton_numba.py does the same in compiled code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from toftrack.checks import check_number
from toftrack.compute.rotations import rotvec_composition
from toftrack.compute.transfer import table
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import ANGLE_LIMITS, HandPose, forward_kinematics
from toftrack.hand.surface import HandSurface, hand_surface
from toftrack.refinement.seen_points import SeenPoints

# The joints of the 21 angles: (finger, bone that moves first, is it an abduction).
_JOINTS = [
    (finger, bone, abduction)
    for finger in range(5)
    for bone, abduction in ((0, True), (0, False), (1, True), (1, False), (2, False))
    if finger == 0 or (bone, abduction) != (1, True)
]
AXIS_ROW = tuple(
    3 * finger + bone if not abduction else 15 + finger if bone == 0 else 20
    for finger, bone, abduction in _JOINTS
)
"""Rows of the table of axes that `point_jacobian` builds: the x axes of the 15 bones (flexion), the
z axes of the 5 base frames (abduction of the first joint), the z axis of the thumb's first bone."""
ORIGIN_ROW = tuple(1 + 3 * finger + bone for finger, bone, _ in _JOINTS)
"""The frames in whose origins these axes lie."""
MOVES = tuple(
    tuple(f > 0 and finger == (f - 1) // 3 and bone <= (f - 1) % 3 for finger, bone, _ in _JOINTS)
    for f in range(16)
)
"""(16, 21) which angles move a point that is attached to a frame."""
JOINT_FRAME = (
    0,
    *(0 if bone == 0 else 3 * finger + bone for finger in range(5) for bone in range(4)),
)
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
    """How an estimate is refined; see conf/refine/gauss_newton.yaml for what each does.

    iterations: Gauss-Newton steps; 0 leaves the filter's estimate as it is.
    points: seen points that are used at most.
    reach_m: points farther than this from the surface are no part of the hand.
    point_m, silhouette_px, angle_rad: standard deviations of the three kinds of residual: smaller
        ones count more.
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

    def of_each(self, n: int) -> Keypoints:
        """(n, 21, 3) and (n, 21); what is no number becomes a joint that was not found."""
        points = self.points_m.expand(n, 21, 3)
        known = points.isfinite().all(-1) & (self.sigma_m > 0)
        sigma = torch.where(known, self.sigma_m, torch.inf)
        return Keypoints(torch.where(known[..., None], points, 0.0), sigma)


class Refiner(Protocol):
    """Brings hands of one shape onto the seen points."""

    def __call__(
        self,
        states: Tensor,
        prior_angles: Tensor,
        seen: SeenPoints,
        settings: Refinement,
        keypoints: Keypoints | None = None,
    ) -> Tensor:
        """See refine."""

    def joints(self, states: Tensor) -> Tensor:
        """(N, 27) to the joints (N, 21, 3), camera frame, metres."""

    def pose(self, states: Tensor) -> HandPose:
        """(N, 27) to joints and frames, see skeleton.forward_kinematics."""


class TorchRefiner:
    """The reference, which runs on any device."""

    def __init__(self, shape: HandShape, surface: HandSurface | None = None) -> None:
        """shape: on the device of the states to come.  surface: instead of the shape's own."""
        self.shape = shape
        self.surface = surface or hand_surface(shape)

    def __call__(
        self,
        states: Tensor,
        prior_angles: Tensor,
        seen: SeenPoints,
        settings: Refinement,
        keypoints: Keypoints | None = None,
    ) -> Tensor:
        """See refine."""
        return refine(states, prior_angles, seen, self.shape, self.surface, settings, keypoints)

    def joints(self, states: Tensor) -> Tensor:
        """See Refiner."""
        return self.pose(states).joints_m

    def pose(self, states: Tensor) -> HandPose:
        """See Refiner."""
        return forward_kinematics(states, self.shape)


class Residuals(NamedTuple):
    """R residuals of N hypotheses, in standard deviations.

    rows: (N, R, 27) their derivatives by translation, rotation and angles.  values: (N, R).
    """

    rows: Tensor
    values: Tensor


def point_jacobian(pose: HandPose, shape: HandShape, x: Tensor, n: Tensor, frame: Tensor) -> Tensor:
    """How n.X changes with the 27 degrees of freedom for points X that move with frames.

    pose: of N hands.  x, n: (N, P, 3) points and directions in the camera frame.
    frame: (P,) or (N, P) which of the 16 frames each point is attached to.
    Returns (N, P, 27): translation, small rotation about the wrist in the camera frame, angles.
    """
    frames, origins = pose.frames, pose.origins_m
    axis_row, origin_row = table((AXIS_ROW, ORIGIN_ROW), torch.int64, x.device)
    base = (frames[:, 0] @ shape.base_frames[:, :, 2].mT).mT
    axes = torch.cat((frames[:, 1:, :, 0], base, frames[:, 1:2, :, 2]), 1)[:, axis_row]
    if shape.side == "left":  # a mirror turns the sense of rotation round
        axes = -axes
    # n.(a x (X - o)) = (n x a).(o - X) = a.((X - o) x n)
    arm_moment = torch.linalg.cross(x, n)
    turning = arm_moment @ axes.mT - n @ torch.linalg.cross(axes, origins[:, origin_row]).mT
    by_angle = turning * table(MOVES, torch.bool, x.device)[frame]
    by_rotation = torch.linalg.cross(x - origins[:, :1], n)
    return torch.cat((n, by_rotation, by_angle), -1)


def refine(
    states: Tensor,
    prior_angles: Tensor,
    seen: SeenPoints,
    shape: HandShape,
    surface: HandSurface,
    settings: Refinement,
    keypoints: Keypoints | None = None,
) -> Tensor:
    """Bring N hands onto the seen points, each by itself.

    states: (N, 27).  prior_angles: (N, 21) the poses that the filter believes in.
    keypoints: joints that are known besides.
    Returns (N, 27); a hand within whose reach nothing is seen, and of which no keypoint is known,
    stays as it is.
    """
    middle = forward_kinematics(states, shape).joints_m.mean(1)
    points, there = seen.around(middle, settings.points)
    informed = there.any(1)
    if keypoints is not None:
        keypoints = keypoints.of_each(len(states))
        informed = informed | keypoints.sigma_m.isfinite().any(1)
    refined = states
    for _ in range(settings.iterations):
        pose = forward_kinematics(refined, shape)
        parts = [
            point_residuals(pose, points, there, shape, surface, settings),
            silhouette_residuals(pose, seen, shape, settings),
        ]
        if keypoints is not None:
            parts.append(keypoint_residuals(pose, keypoints, shape))
        rows, values = (torch.cat(part, 1) for part in zip(*parts, strict=True))
        step = _step(rows, values, refined[:, 6:] - prior_angles, settings)
        refined = _moved(refined, step)
    return torch.where(informed[:, None], refined, states)


def _step(rows: Tensor, values: Tensor, off_prior: Tensor, settings: Refinement) -> Tensor:
    """(N, 27) the damped step that lowers the squared residuals and the distance to the prior."""
    normal = rows.mT @ rows
    gradient = (rows.mT @ values[..., None])[..., 0]
    angles = torch.arange(6, 27, device=rows.device)
    weight = settings.angle_rad**-2
    normal[:, angles, angles] += weight
    gradient[:, 6:] += weight * off_prior
    diagonal = normal.diagonal(dim1=1, dim2=2)
    damping = settings.damping * diagonal.mean(1, keepdim=True) + 1e-3 * diagonal
    # Hands that are no numbers stay so, and stop nobody else.
    return -torch.linalg.solve_ex(normal + damping.diag_embed(), gradient).result


def _moved(states: Tensor, step: Tensor) -> Tensor:
    """States after a step of translation, rotation in the camera frame and angles, in limits."""
    low, high = table(ANGLE_LIMITS, states.dtype, states.device).unbind(1)
    turned = rotvec_composition(step[:, 3:6], states[:, 3:6])
    bent = (states[:, 6:] + step[:, 6:]).clamp(low, high)
    return torch.cat((states[:, :3] + step[:, :3], turned, bent), 1)


def nearest_ellipsoids(
    pose: HandPose, points: Tensor, surface: HandSurface
) -> tuple[Tensor, Tensor, Tensor]:
    """The hand's ellipsoid that is nearest to each of the points (N, P, 3).

    Returns the first-order distance to it (N, P), metres, below 0 inside; which it is (N, P); and
    its normal there (N, P, 3).
    """
    ellipsoids = surface.pose(pose)
    centres, axes = ellipsoids.centres_m[:, :-1], ellipsoids.axes_m[:, :-1]
    whiten = axes.mT / axes.square().sum(-2)[..., None]  # (N, E, 3, 3)
    # First-order distance to each ellipsoid: (|q| - 1) |q| / |W'q| with q = W (p - c).
    q = points[:, None] @ whiten.mT - (whiten @ centres[..., None]).mT  # (N, E, P, 3)
    gradient = q @ whiten
    length, steepness = q.norm(dim=-1), gradient.norm(dim=-1).clamp(min=1e-6)
    distance, nearest = ((length - 1) * length / steepness).min(1)
    chosen = nearest[:, None, :, None].expand(-1, 1, -1, 3)
    normals = (gradient / steepness[..., None]).gather(1, chosen)[:, 0]
    return distance, nearest, normals


def point_residuals(
    pose: HandPose,
    points: Tensor,
    there: Tensor,
    shape: HandShape,
    surface: HandSurface,
    settings: Refinement,
) -> Residuals:
    """Of the seen points (N, P, 3) that are there (N, P): their distances from the surface."""
    distance, nearest, normals = nearest_ellipsoids(pose, points, surface)
    # Seen surfaces face the camera; what lies beyond the wrist is the arm.
    facing = (normals * points).sum(-1) < 0
    off_wrist = points - pose.origins_m[:, :1]
    beyond = (off_wrist @ pose.frames[:, 0, :, 1, None])[..., 0] > FACING_M
    use = there & facing & ~beyond & (distance.abs() < settings.reach_m)
    # Geman and McClure's robust weight, which forgets outliers.
    weight = use / (1 + (distance / (POINT_REACH * settings.reach_m)).square()) / settings.point_m
    x = points - distance[..., None] * normals
    rows = point_jacobian(pose, shape, x, normals, surface.frame_index[nearest])
    # The model's surface moves towards the point: the distance falls as n.X grows.
    return Residuals(-rows * weight[..., None], distance * weight)


def silhouette_residuals(
    pose: HandPose, seen: SeenPoints, shape: HandShape, settings: Refinement
) -> Residuals:
    """Of points on the bones' axes: how far they stick out of the silhouette, in u and in v."""
    frames, origins = pose.frames[:, 1:], pose.origins_m[:, 1:]
    (top, left), (high, wide) = seen.corner, seen.nearest_px.shape[:2]
    if high == 0:
        return Residuals(frames.new_zeros(len(frames), 0, 27), frames.new_zeros(len(frames), 0))
    parts = table(ALONG_BONE, origins.dtype, origins.device)
    along = -frames[..., 1] * shape.bone_lengths_m.flatten()[:, None]
    x = (origins[:, :, None] + parts[:, None] * along[:, :, None]).flatten(1, 2)
    frame = torch.arange(1, 16, device=x.device).repeat_interleave(len(parts))
    height, width = seen.size
    k, z = seen.k, x[..., 2].clamp(min=NEAREST_M)
    u, v = k[0, 0] * x[..., 0] / z + k[0, 2], k[1, 1] * x[..., 1] / z + k[1, 2]
    inside = (u > 0) & (u < width - 1) & (v > 0) & (v < height - 1)
    column = (u.nan_to_num().round().long() - left).clamp(0, wide - 1)
    row = (v.nan_to_num().round().long() - top).clamp(0, high - 1)
    gap = torch.stack((u, v), -1) - seen.nearest_px[row, column]
    outside = gap.norm(dim=-1)
    weight = (inside & (outside > 1.0)) / (1 + (outside / SILHOUETTE_PX).square())
    weight = weight.repeat(1, 2) / settings.silhouette_px
    zero = torch.zeros_like(z)
    by_u = torch.stack((k[0, 0] / z, zero, -k[0, 0] * x[..., 0] / z.square()), -1)
    by_v = torch.stack((zero, k[1, 1] / z, -k[1, 1] * x[..., 1] / z.square()), -1)
    by = torch.cat((by_u, by_v), 1)
    rows = point_jacobian(pose, shape, x.repeat(1, 2, 1), by, frame.repeat(2))
    return Residuals(rows * weight[..., None], gap.mT.flatten(1) * weight)


def keypoint_residuals(pose: HandPose, keypoints: Keypoints, shape: HandShape) -> Residuals:
    """Of the joints: how far they are from their keypoints, along each of the camera's axes.

    keypoints: of each of the N hands, see Keypoints.of_each.
    """
    gap = pose.joints_m - keypoints.points_m
    sigma = keypoints.sigma_m
    away = (gap.norm(dim=-1) / (KEYPOINT_SIGMAS * sigma)).square()
    weight = (1 / ((1 + away) * sigma)).repeat_interleave(3, 1)
    x = pose.joints_m.repeat_interleave(3, 1)
    n = torch.eye(3, dtype=x.dtype, device=x.device).repeat(21, 1).expand_as(x)
    frame = table(JOINT_FRAME, torch.int64, x.device).repeat_interleave(3)
    rows = point_jacobian(pose, shape, x, n, frame)
    return Residuals(rows * weight[..., None], gap.flatten(1) * weight)
