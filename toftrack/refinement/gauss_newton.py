"""Refinement: damped Gauss-Newton on one hand in all 27 dimensions after the filter.

The filter finds the hand in few dimensions; this brings the surface onto the points that were seen,
an articulated iterative closest point (Tagliasacchi et al., "Robust articulated-ICP for real-time
hand tracking", SGP 2015) with toftrack's ellipsoids:

  * seen points are drawn to the nearest ellipsoid (point to plane along its normal);
  * the bones' axes are drawn into the silhouette where they stick out over the background;
  * the joint angles are drawn to the filter's estimate, the pose space acting as a prior, and are
    kept within the joint limits.

Derivatives are analytic: a joint angle moves a point X by a x (X - o), a the joint's axis and o its
origin, both columns of the kinematic chain's frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import roma
import torch
from torch import Tensor

from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import ANGLE_LIMITS, HandPose, forward_kinematics
from toftrack.hand.surface import HandSurface
from toftrack.refinement.steadying import Steadying
from toftrack.render.segmentation import Observation

# The joints of the 21 angles: (finger, bone that moves first, is it an abduction).
_JOINTS = [
    (finger, bone, abduction)
    for finger in range(5)
    for bone, abduction in ((0, True), (0, False), (1, True), (1, False), (2, False))
    if finger == 0 or (bone, abduction) != (1, True)
]
# Rows of the table of axes that `point_jacobian` builds: the x axes of the 15 bones (flexion), the
# z axes of the 5 base frames (abduction of the first joint), the z axis of the thumb's first bone.
_AXIS_ROW = [
    3 * finger + bone if not abduction else 15 + finger if bone == 0 else 20
    for finger, bone, abduction in _JOINTS
]
_ORIGIN_ROW = [1 + 3 * finger + bone for finger, bone, _ in _JOINTS]
# (16, 21) which angles move a point that is attached to a frame.
_MOVES = [
    [
        frame > 0 and finger == (frame - 1) // 3 and bone <= (frame - 1) % 3
        for finger, bone, _ in _JOINTS
    ]
    for frame in range(16)
]

_REACH_M = 0.16
"""Points farther than this from the middle of the hand are none of it."""
_MARGIN_PX = 24
"""Around the silhouette; beyond it, what sticks out is drawn to where it was nearest to."""
_SQUARE = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class Refinement:
    """How an estimate is refined.

    iterations: Gauss-Newton steps; 0 = none.
    points: seen points that are used at most.
    reach_m: points farther than this from the surface are no part of the hand.
    point_m, silhouette_px, angle_rad: standard deviations of the three kinds of residual: smaller
        ones count more.
    damping: Levenberg's, relative to the mean diagonal of the normal matrix.
    swaps: other poses of single fingers that are tried; one must raise the log score by
        `swap_gain`.
    keep_gain: by how much the log score of another pose must exceed the last frame's.
    steadying: how much of a change from frame to frame is believed.
    carry: part of the pose's distance from the pose space that the next frame's hypotheses keep.
    """

    iterations: int = 5
    points: int = 500
    reach_m: float = 0.025
    point_m: float = 0.004
    silhouette_px: float = 1.0
    angle_rad: float = 0.25
    damping: float = 1e-3
    swaps: int = 128
    swap_gain: float = 0.02
    keep_gain: float = 0.01
    steadying: Steadying = Steadying()
    carry: float = 0.5


@dataclass(frozen=True)
class Surroundings:
    """What the refinement sees of a frame, once a frame.

    points_m: (P, 3) seen points of the hand and the arm.
    nearest_px: (h, w, 2) for each pixel of a crop the nearest pixel (u, v) of the image that is
        not background. The crop holds all of these and a margin.
    k: (3, 3) of the image.
    size: (H, W) of the image.
    corner: row and column of the crop's first pixel.
    """

    points_m: Tensor
    nearest_px: Tensor
    k: Tensor
    size: tuple[int, int]
    corner: tuple[int, int] = (0, 0)


def surroundings(observation: Observation, around_m: Tensor, count: int) -> Surroundings:
    """Points of the silhouette within a hand's reach of `around_m` (3,), at most `count` of them.

    Pixels on depth edges are left out: they mix foreground and background.
    """
    # Whatever is not behind the hand may hide it or be it.
    hand = observation.hand.cpu().numpy()
    solid = hand | observation.occluder.cpu().numpy()
    left, top, wide, high = cv2.boundingRect(solid.view(np.uint8))
    left, right = max(0, left - _MARGIN_PX), min(solid.shape[1], left + wide + _MARGIN_PX)
    top, bottom = max(0, top - _MARGIN_PX), min(solid.shape[0], top + high + _MARGIN_PX)
    part = slice(top, bottom), slice(left, right)
    solid, depth = solid[part], observation.depth_m.cpu().numpy()[part]
    far = np.where(depth > 0, depth, np.float32(10.0))
    smooth = (cv2.dilate(far, _SQUARE) - cv2.erode(far, _SQUARE)) < 0.03
    u, v = _pixels(hand[part] & smooth)
    z = depth[v, u]
    k = observation.k.cpu().numpy()
    points = np.stack(((u + left - k[0, 2]) / k[0, 0] * z, (v + top - k[1, 2]) / k[1, 1] * z, z), 1)
    points = points[np.square(points - around_m.cpu().numpy()).sum(1) < _REACH_M**2]
    points = points[:: max(1, -(-len(points) // count))]
    _, labels = cv2.distanceTransformWithLabels(
        (~solid).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    u, v = _pixels(solid)
    lookup = np.zeros((len(u) + 1, 2), np.float32)
    lookup[labels[v, u]] = np.stack((u + left, v + top), 1)
    device = observation.depth_m.device
    return Surroundings(
        torch.from_numpy(points.astype(np.float32)).to(device),
        torch.from_numpy(lookup.take(labels, 0)).to(device),
        observation.k,
        tuple(observation.hand.shape),
        (top, left),
    )


def _pixels(mask: np.ndarray) -> np.ndarray:
    """Columns and rows of the pixels of a mask, (2, n) int32, row by row."""
    found = cv2.findNonZero(mask.view(np.uint8))
    return np.zeros((2, 0), np.int32) if found is None else found.reshape(-1, 2).T


class Refiner(Protocol):
    """Brings hands of one shape onto the seen points."""

    def __call__(
        self, state: Tensor, prior_angles: Tensor, seen: Surroundings, settings: Refinement
    ) -> Tensor:
        """See refine."""

    def joints(self, state: Tensor) -> Tensor:
        """(1, 27) to the joints (21, 3), camera frame, metres."""


@dataclass(frozen=True)
class TorchRefiner:
    """The reference, which runs everywhere."""

    shape: HandShape
    surface: HandSurface

    def __call__(
        self, state: Tensor, prior_angles: Tensor, seen: Surroundings, settings: Refinement
    ) -> Tensor:
        """See refine."""
        return refine(state, prior_angles, seen, self.shape, self.surface, settings)

    def joints(self, state: Tensor) -> Tensor:
        """See Refiner."""
        return forward_kinematics(state, self.shape).joints_m[0]


def make_refiner(shape: HandShape, surface: HandSurface, scorer: str) -> Refiner:
    """The refiner that goes with a scoring back end: compiled where that is "numba"."""
    if scorer == "numba" and shape.base_m.device.type == "cpu":
        from toftrack.refinement.gauss_newton_numba import CompiledRefiner

        return CompiledRefiner(shape, surface)
    return TorchRefiner(shape, surface)


def point_jacobian(pose: HandPose, shape: HandShape, x: Tensor, n: Tensor, frame: Tensor) -> Tensor:
    """How n.X changes with the 27 degrees of freedom for points X that move with frames.

    pose: of one hand.  x, n: (P, 3) points and directions in the camera frame.
    frame: (P,) which of the 16 frames each point is attached to.
    Returns (P, 27): translation, small rotation about the wrist in the camera frame, angles.
    """
    frames, origins = pose.frames[0], pose.origins_m[0]
    base = (frames[0] @ shape.base_frames[:, :, 2].mT).mT
    axes = torch.cat((frames[1:, :, 0], base, frames[1:2, :, 2]))[_AXIS_ROW]
    if shape.side == "left":  # a mirror turns the sense of rotation round
        axes = -axes
    # n.(a x (X - o)) = (n x a).(o - X) = a.((X - o) x n)
    arm_moment = torch.linalg.cross(x, n)
    turning = arm_moment @ axes.mT - n @ torch.linalg.cross(axes, origins[_ORIGIN_ROW]).mT
    by_angle = turning * torch.tensor(_MOVES, device=x.device)[frame]
    by_rotation = torch.linalg.cross(x - origins[0], n)
    return torch.cat((n, by_rotation, by_angle), 1)


def refine(
    state: Tensor,
    prior_angles: Tensor,
    seen: Surroundings,
    shape: HandShape,
    surface: HandSurface,
    settings: Refinement,
) -> Tensor:
    """Bring one hand onto the seen points.

    state: (1, 27).  prior_angles: (1, 21) the pose that the filter believes in.
    Returns (1, 27).
    """
    limits = state.new_tensor(ANGLE_LIMITS)
    for _ in range(settings.iterations):
        pose = forward_kinematics(state, shape)
        rows, residuals, _ = linearised(pose, seen, shape, surface, settings)
        normal = rows.mT @ rows
        gradient = rows.mT @ residuals
        angles = torch.arange(6, 27, device=state.device)
        weight = settings.angle_rad**-2
        normal[angles, angles] += weight
        gradient[6:] += weight * (state - torch.nn.functional.pad(prior_angles, (6, 0)))[0, 6:]
        diagonal = normal.diagonal()
        damped = normal + torch.diag(settings.damping * diagonal.mean() + 1e-3 * diagonal)
        step = -torch.linalg.solve(damped, gradient)
        turned = roma.rotvec_composition((step[None, 3:6], state[:, 3:6]))
        bent = (state[0, 6:] + step[6:]).clamp(limits[:, 0], limits[:, 1])
        state = torch.cat((state[:, :3] + step[None, :3], turned, bent[None]), 1)
    return state


def linearised(
    pose: HandPose,
    seen: Surroundings,
    shape: HandShape,
    surface: HandSurface,
    settings: Refinement,
) -> tuple[Tensor, Tensor, Tensor]:
    """What the seen points and the silhouette say of a pose, in standard deviations.

    Returns the Jacobian (R, 27), the residuals (R,) and the points that they are about (R, 3).
    """
    parts = (
        _point_rows(pose, seen.points_m, shape, surface, settings),
        _silhouette_rows(pose, seen, shape, settings),
    )
    rows, residuals, points = (torch.cat(part) for part in zip(*parts, strict=True))
    return rows, residuals, points


def _point_rows(
    pose: HandPose,
    points: Tensor,
    shape: HandShape,
    surface: HandSurface,
    settings: Refinement,
) -> tuple[Tensor, Tensor, Tensor]:
    """Weighted rows of the seen points: (P, 27), (P,) in standard deviations, (P, 3)."""
    ellipsoids = surface.pose(pose)
    centres, axes = ellipsoids.centres_m[0, :-1], ellipsoids.axes_m[0, :-1]
    whiten = axes.mT / axes.square().sum(-2)[..., None]  # (E, 3, 3)
    # First-order distance to each ellipsoid: (|q| - 1) |q| / |W'q| with q = W (p - c).
    q = points @ whiten.mT - (whiten @ centres[..., None]).mT  # (E, P, 3)
    gradient = q @ whiten
    length, steepness = q.norm(dim=-1), gradient.norm(dim=-1).clamp(min=1e-6)
    distance, nearest = ((length - 1) * length / steepness).min(0)
    index = torch.arange(len(points), device=points.device)
    normals = gradient[nearest, index] / steepness[nearest, index, None]
    # Seen surfaces face the camera; what lies beyond the wrist is the arm.
    facing = (normals * points).sum(-1) < 0
    beyond = (points - pose.origins_m[0, 0]) @ pose.frames[0, 0, :, 1] > 0.005
    use = facing & ~beyond & (distance.abs() < settings.reach_m)
    # Geman and McClure's robust weight, which forgets outliers.
    weight = use / (1 + (distance / (0.4 * settings.reach_m)).square()) / settings.point_m
    x = points - distance[:, None] * normals
    rows = point_jacobian(pose, shape, x, normals, surface.frame_index[nearest])
    # The model's surface moves towards the point: the distance falls as n.X grows.
    return -rows * weight[:, None], distance * weight, x


def _silhouette_rows(
    pose: HandPose, seen: Surroundings, shape: HandShape, settings: Refinement
) -> tuple[Tensor, Tensor, Tensor]:
    """Weighted rows that draw the bones' axes into the silhouette, two for each point."""
    frames, origins = pose.frames[0, 1:], pose.origins_m[0, 1:]
    parts = origins.new_tensor([0.25, 0.6, 0.9])
    along = -frames[:, :, 1] * shape.bone_lengths_m.flatten()[:, None]
    x = (origins[:, None] + parts[:, None] * along[:, None]).flatten(0, 1)
    frame = torch.arange(1, 16, device=x.device).repeat_interleave(len(parts))
    height, width = seen.size
    k, z = seen.k, x[:, 2].clamp(min=0.05)
    u, v = k[0, 0] * x[:, 0] / z + k[0, 2], k[1, 1] * x[:, 1] / z + k[1, 2]
    inside = (u > 0) & (u < width - 1) & (v > 0) & (v < height - 1)
    (top, left), (high, wide) = seen.corner, seen.nearest_px.shape[:2]
    column = (u.round().long() - left).clamp(0, wide - 1)
    row = (v.round().long() - top).clamp(0, high - 1)
    gap = torch.stack((u, v), 1) - seen.nearest_px[row, column]
    outside = gap.norm(dim=1)
    weight = (inside & (outside > 1.0)) / (1 + (outside / 8.0).square()) / settings.silhouette_px
    zero = torch.zeros_like(z)
    by_u = torch.stack((k[0, 0] / z, zero, -k[0, 0] * x[:, 0] / z.square()), 1)
    by_v = torch.stack((zero, k[1, 1] / z, -k[1, 1] * x[:, 1] / z.square()), 1)
    rows = point_jacobian(pose, shape, x.repeat(2, 1), torch.cat((by_u, by_v)), frame.repeat(2))
    return rows * weight.repeat(2)[:, None], gap.mT.flatten() * weight.repeat(2), x.repeat(2, 1)
