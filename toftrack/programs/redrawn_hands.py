"""Images whose hand is redrawn as toftrack's own ellipsoids; a part of measure_detector.

The network is trained on such hands, among others. What it misses on the images as they are, and
not on these, is due to the look of the hand: skin, not pose, size, place or surroundings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import roma
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from toftrack.detector.proposals import MIRROR, MIRROR_TURN
from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import HandPose, forward_kinematics
from toftrack.pose_space.inverse_kinematics import (
    fit_angles,
    shape_of_joints,
    straight_finger_directions,
)
from toftrack.refinement.gauss_newton import nearest_ellipsoids
from toftrack.render.model_image import cpu_surface, model_range_image

NEAR_M = 0.02
"""Readings so near to the fitted hand are of the recorded one."""
_EDGE_M = 0.02
"""Depths of neighbours that differ by more are of two surfaces."""
_MIXED = 0.75
"""How much of the way to what lies behind a pixel is, at most, that mixes both."""
_ARM_M = -0.02
"""Readings from so far beyond the wrist on, towards the elbow, are the arm's, and stay."""
_RING = np.ones((3, 3), np.uint8)
_GAUSSIAN = 1.4826 / math.sqrt(1.5)
"""From the median absolute difference to two neighbours' mean to a standard deviation."""


@dataclass(frozen=True, eq=False)
class FittedHands:
    """states: (T, 27) of hands of one shape.  joints_m: (T, 21, 3) theirs, camera frame."""

    states: Tensor
    shape: HandShape
    joints_m: np.ndarray


def fitted_hands(joints_m: np.ndarray, side: str) -> FittedHands:
    """Hands of a person's bones in the poses of true joints (T, 21, 3), which must be finite.

    Raises ToftrackError for joints that are no numbers.
    """
    left = side == "left"
    mirror, mirror_turn = (part if left else torch.ones(3) for part in (MIRROR, MIRROR_TURN))
    fingers = (torch.from_numpy(joints_m).double() * mirror)[:, 1:].unflatten(1, (5, 4))
    mean = default_hand_shape().to(torch.float64)
    sine, cosine = straight_finger_directions(fingers, mean).tolist()
    shape = shape_of_joints(fingers, mean, math.atan2(sine, cosine))
    states = torch.zeros(len(fingers), 27, dtype=torch.float64)
    states[:, 6:] = fit_angles(fingers, shape).angles_rad
    own = forward_kinematics(states, shape).joints_m[:, 1:]
    rotation, translation = roma.rigid_points_registration(own, fingers.flatten(1, 2))
    states[:, :3] = translation * mirror
    states[:, 3:6] = roma.rotmat_to_rotvec(rotation) * mirror_turn
    states, shape = states.float(), shape.to("cpu", torch.float32).of_side(side)
    joints = forward_kinematics(states, shape).joints_m.numpy()
    return FittedHands(states, shape, joints)


def redrawn(
    depth_m: np.ndarray,
    k: np.ndarray,
    state: Tensor,
    shape: HandShape,
    generator: torch.Generator,
) -> np.ndarray:
    """An image (H, W), metres, 0 = no reading, with a fitted hand, (27,), instead of the recorded.

    The recorded hand's pixels show what is seen behind it beside them; the new one has the old
    one's noise, its missing pixels, and its share of mixed ones along edges. The arm, and what is
    in front of the hand, stay.
    """
    solid = _distance(depth_m, k, state, shape) < NEAR_M
    drawn = model_range_image(state.numpy(), shape, k, *depth_m.shape)
    inside = drawn > 0
    if not (solid.any() and inside.any()):
        return depth_m
    nearest = np.where(inside, drawn, depth_m[solid].min())
    front = (depth_m > 0) & ~solid & (depth_m < nearest)
    ring = _beside(solid) & ~front
    behind = _filled(depth_m, (solid | ring | inside) & ~front, float(np.median(depth_m[solid])))
    # Of the pixels around the hand some mix its depth and that of what is behind.
    old, new = (
        cv2.dilate(np.where(mask, z, 0), _RING) for mask, z in ((solid, depth_m), (inside, drawn))
    )
    far = np.where(behind > 0, behind, depth_m.max())
    mixed = ring & (depth_m > old + _EDGE_M) & (depth_m < old + _MIXED * (far - old))
    share = mixed.sum() / max(1, int(ring.sum()))
    part, chance = torch.rand(2, *depth_m.shape, generator=generator).numpy()
    mixing = _beside(inside) & ~front & (far > new + _EDGE_M) & (chance < share)
    image = np.where(mixing, new + _MIXED * part * (far - new), behind)
    noise = torch.randn(depth_m.shape, generator=generator).numpy()
    image = np.where(inside & ~front, drawn + _noise_m(depth_m, solid) * noise, image)
    missing = _shrunk(solid | _beside(solid)) & (depth_m == 0)
    return np.where(missing, 0, image).astype(np.float32)


def _distance(depth_m: np.ndarray, k: np.ndarray, state: Tensor, shape: HandShape) -> np.ndarray:
    """(H, W) of readings from the hand, metres; inf where none is, and of the arm's."""
    pose: HandPose = forward_kinematics(state[None], shape)
    joints = pose.joints_m[0].numpy()
    low, high = joints[:, 2].min() - 2 * NEAR_M, joints[:, 2].max() + 2 * NEAR_M
    v, u = np.nonzero((depth_m > low) & (depth_m < high))
    z = depth_m[v, u]
    points = np.stack(((u - k[0, 2]) / k[0, 0] * z, (v - k[1, 2]) / k[1, 1] * z, z), 1)
    near = (points > joints.min(0) - 2 * NEAR_M) & (points < joints.max(0) + 2 * NEAR_M)
    chosen = near.all(1)
    seen = torch.from_numpy(points[chosen].astype(np.float32))[None]
    distance = nearest_ellipsoids(pose, seen, cpu_surface(shape))[0][0]
    beyond = ((seen[0] - pose.origins_m[0, :1]) @ pose.frames[0, 0, :, 1]) > _ARM_M
    away = np.full(depth_m.shape, np.inf, np.float32)
    away[v[chosen], u[chosen]] = torch.where(beyond, torch.inf, distance).numpy()
    return away


def _filled(depth_m: np.ndarray, gone: np.ndarray, hand_m: float) -> np.ndarray:
    """The image with what is gone as the nearest pixel that shows no more than lies behind."""
    source = ~gone & ((depth_m == 0) | (depth_m > hand_m + _EDGE_M))
    if not source.any():
        return np.where(gone, 0, depth_m)
    row, column = distance_transform_edt(~source, return_distances=False, return_indices=True)
    return np.where(gone, depth_m[row, column], depth_m)


def _beside(mask: np.ndarray) -> np.ndarray:
    """(H, W) the pixels around a mask."""
    return (cv2.dilate(mask.view(np.uint8), _RING) > 0) & ~mask


def _shrunk(mask: np.ndarray) -> np.ndarray:
    """(H, W) a mask without its outermost pixels."""
    inner: np.ndarray = cv2.erode(mask.view(np.uint8), _RING) > 0
    return inner


def _noise_m(depth_m: np.ndarray, solid: np.ndarray) -> float:
    """Standard deviation of the hand's readings about their neighbours' mean."""
    between = solid[:, :-2] & solid[:, 1:-1] & solid[:, 2:]
    off = depth_m[:, 1:-1] - 0.5 * (depth_m[:, :-2] + depth_m[:, 2:])
    return _GAUSSIAN * float(np.median(np.abs(off[between]))) if between.any() else 0.0
