"""The reference of refinement/gauss_newton_numba.py: the same in plain torch, step by step."""

from typing import NamedTuple

import torch
from torch import Tensor

from toftrack.compute.rotations import rotvec_composition
from toftrack.compute.transfer import table
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import ANGLE_LIMITS, HandPose, forward_kinematics
from toftrack.hand.surface import HandSurface, hand_surface
from toftrack.refinement.gauss_newton import (
    ALONG_BONE,
    FACING_M,
    JOINT_FRAME,
    KEYPOINT_SIGMAS,
    NEAREST_M,
    POINT_REACH,
    SILHOUETTE_PX,
    Keypoints,
    Refinement,
)
from toftrack.refinement.seen_points import REACH_M, SeenPoints


class Residuals(NamedTuple):
    """R residuals of N hypotheses, in standard deviations.

    rows: (N, R, 27) their derivatives by translation, rotation and angles.  values: (N, R).
    """

    rows: Tensor
    values: Tensor


class Moving(NamedTuple):
    """N hands, and how their frames change with the 27 degrees of freedom: translation, small
    rotation about the wrist in the camera frame, angles.

    frames_by: (27, N, 16, 3, 3).  origins_by: (27, N, 16, 3).
    """

    pose: HandPose
    frames_by: Tensor
    origins_by: Tensor


def moving(states: Tensor, shape: HandShape) -> Moving:
    """Of hands (N, 27), by automatic differentiation."""

    def after(step: Tensor) -> tuple[Tensor, Tensor]:
        end = forward_kinematics(moved(states, step.expand_as(states)), shape)
        return end.frames, end.origins_m

    by = torch.func.jacfwd(after)(states.new_zeros(27))
    return Moving(forward_kinematics(states, shape), *(each.movedim(-1, 0) for each in by))


def moved(states: Tensor, step: Tensor) -> Tensor:
    """States after a step of translation, rotation in the camera frame and angles, (N, 27) each."""
    turned = rotvec_composition(step[:, 3:6], states[:, 3:6])
    return torch.cat((states[:, :3] + step[:, :3], turned, states[:, 6:] + step[:, 6:]), 1)


def point_jacobian(hand: Moving, x: Tensor, n: Tensor, frame: Tensor) -> Tensor:
    """(N, P, 27) how n.X changes with the degrees of freedom for points X that move with frames.

    x, n: (N, P, 3) points and directions in the camera frame.
    frame: (P,) or (N, P) which of the 16 frames each point is attached to.
    """
    at = torch.arange(len(x))[:, None], frame.expand(x.shape[:2])
    local = hand.pose.frames[at].mT @ (x - hand.pose.origins_m[at])[..., None]
    by = (hand.frames_by[:, *at] @ local)[..., 0] + hand.origins_by[:, *at]
    return (by * n).sum(-1).movedim(0, -1)


def points_around(seen: SeenPoints, middle_m: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The points of each of N hypotheses: those within its reach, thinned out evenly.

    middle_m: (N, 3) mean of a hypothesis' joints.  count: points of a hypothesis at most.
    Returns the points (N, C, 3), and which of them there are, (N, C) bool.
    """
    total = len(seen.points_m)
    near = (seen.points_m - middle_m[:, None]).square().sum(-1) < REACH_M**2
    stride = (near.sum(1, keepdim=True) + count - 1).div(count, rounding_mode="floor")
    rank = near.cumsum(1) - 1
    kept = near & (rank % stride.clamp(min=1) == 0)
    # What is not kept goes to one place past the end.
    slots = min(count, total)
    to = torch.where(kept, rank // stride.clamp(min=1), slots)
    index = to.new_zeros(len(near), slots + 1)
    index.scatter_(1, to, torch.arange(total, device=to.device).expand_as(to))
    there = torch.arange(slots, device=to.device) < kept.sum(1, keepdim=True)
    return seen.points_m[index[:, :slots]], there


def refine(
    states: Tensor,
    prior_angles: Tensor,
    seen: SeenPoints,
    shape: HandShape,
    settings: Refinement,
    keypoints: Keypoints | None = None,
) -> Tensor:
    """What Refiner does with hands (N, 27)."""
    surface = hand_surface(shape)
    middle = forward_kinematics(states, shape).joints_m.mean(1)
    points, there = points_around(seen, middle, settings.points)
    informed = there.any(1)
    if keypoints is not None:
        keypoints = of_each(keypoints, len(states))
        informed = informed | keypoints.sigma_m.isfinite().any(1)
    refined = states
    for _ in range(settings.iterations):
        hand = moving(refined, shape)
        parts = [
            point_residuals(hand, points, there, surface, settings),
            silhouette_residuals(hand, seen, shape, settings),
        ]
        if keypoints is not None:
            parts.append(keypoint_residuals(hand, keypoints))
        rows, values = (torch.cat(part, 1) for part in zip(*parts, strict=True))
        step = _step(rows, values, refined[:, 6:] - prior_angles, settings)
        low, high = table(ANGLE_LIMITS, step.dtype, step.device).unbind(1)
        refined = moved(refined, step)
        refined[:, 6:] = refined[:, 6:].clamp(low, high)
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
    hand: Moving, points: Tensor, there: Tensor, surface: HandSurface, settings: Refinement
) -> Residuals:
    """Of the seen points (N, P, 3) that are there (N, P): their distances from the surface."""
    pose = hand.pose
    distance, nearest, normals = nearest_ellipsoids(pose, points, surface)
    # Seen surfaces face the camera; what lies beyond the wrist is the arm.
    facing = (normals * points).sum(-1) < 0
    off_wrist = points - pose.origins_m[:, :1]
    beyond = (off_wrist @ pose.frames[:, 0, :, 1, None])[..., 0] > FACING_M
    use = there & facing & ~beyond & (distance.abs() < settings.reach_m)
    # Geman and McClure's robust weight, which forgets outliers.
    weight = use / (1 + (distance / (POINT_REACH * settings.reach_m)).square()) / settings.point_m
    x = points - distance[..., None] * normals
    rows = point_jacobian(hand, x, normals, surface.frame_index[nearest])
    # The model's surface moves towards the point: the distance falls as n.X grows.
    return Residuals(-rows * weight[..., None], distance * weight)


def silhouette_residuals(
    hand: Moving, seen: SeenPoints, shape: HandShape, settings: Refinement
) -> Residuals:
    """Of points on the bones' axes: how far they stick out of the silhouette, in u and in v."""
    frames, origins = hand.pose.frames[:, 1:], hand.pose.origins_m[:, 1:]
    (top, left), (high, wide) = seen.corner, seen.beside.shape
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
    gap = torch.stack((u, v), -1) - nearest_px(seen, row, column)
    outside = gap.norm(dim=-1)
    weight = (inside & (outside > 1.0)) / (1 + (outside / SILHOUETTE_PX).square())
    weight = weight.repeat(1, 2) / settings.silhouette_px
    zero = torch.zeros_like(z)
    by_u = torch.stack((k[0, 0] / z, zero, -k[0, 0] * x[..., 0] / z.square()), -1)
    by_v = torch.stack((zero, k[1, 1] / z, -k[1, 1] * x[..., 1] / z.square()), -1)
    by = torch.cat((by_u, by_v), 1)
    rows = point_jacobian(hand, x.repeat(1, 2, 1), by, frame.repeat(2))
    return Residuals(rows * weight[..., None], gap.mT.flatten(1) * weight)


def nearest_px(seen: SeenPoints, row: Tensor, column: Tensor) -> Tensor:
    """(..., 2) column and row, in the image, of the pixels that are not background and nearest to
    pixels of the crop (...,); of several the one in the nearer row, above, to the left.
    """
    columns = torch.arange(seen.beside.shape[1])
    solid = (seen.beside == columns).nonzero()
    down, right = (solid - torch.stack((row, column), -1).reshape(-1, 1, 2)).unbind(-1)
    away = down**2 + right**2 + 1e-4 * down.abs() + 1e-6 * (down > 0) + 1e-8 * (right > 0).double()
    found = solid[away.argmin(1)] + torch.tensor(seen.corner)
    return found.flip(1).to(seen.k.dtype).reshape(*row.shape, 2)


def of_each(keypoints: Keypoints, n: int) -> Keypoints:
    """(n, 21, 3) and (n, 21); what is no number becomes a joint that was not found."""
    points, sigma = keypoints.points_m.expand(n, 21, 3), keypoints.sigma_m
    known = points.isfinite().all(-1) & (sigma > 0)
    found = torch.where(known, sigma, torch.inf)
    return Keypoints(torch.where(known[..., None], points, 0.0), found)


def keypoint_residuals(hand: Moving, keypoints: Keypoints) -> Residuals:
    """Of the joints: how far they are from their keypoints, along each of the camera's axes.

    keypoints: of each of the N hands, see of_each.
    """
    gap = hand.pose.joints_m - keypoints.points_m
    sigma = keypoints.sigma_m
    away = (gap.norm(dim=-1) / (KEYPOINT_SIGMAS * sigma)).square()
    weight = (1 / ((1 + away) * sigma)).repeat_interleave(3, 1)
    x = hand.pose.joints_m.repeat_interleave(3, 1)
    n = torch.eye(3, dtype=x.dtype, device=x.device).repeat(21, 1).expand_as(x)
    frame = table(JOINT_FRAME, torch.int64, x.device).repeat_interleave(3)
    rows = point_jacobian(hand, x, n, frame)
    return Residuals(rows * weight[..., None], gap.flatten(1) * weight)
