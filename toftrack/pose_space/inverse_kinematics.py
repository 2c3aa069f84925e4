"""Joint angles from joint positions: batched inverse kinematics on the tracker's skeleton.

Levenberg-Marquardt (Levenberg 1944, Marquardt 1963) over the 27 degrees of freedom of every frame
at once; the joint limits are kept by projection after every step.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import roma
import torch
from torch import Tensor

from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import (
    ANGLE_LIMITS,
    CHAIN_SLOTS,
    JOINT_MOVES,
    SLOT_BONES,
    HandPose,
    forward_kinematics,
)

_UNIT_M = 1e-2
"""Residuals are near one in this unit, so that damping and prior need none."""
_STRAIGHT = 0.97
"""A finger whose ends are at least this part of its length apart is straight."""
# The thumb's root is where two skeletons agree least; it only has to tell the palm's tilt.
_ROOT_WEIGHTS = (0.1, 1.0, 1.0, 1.0, 1.0)


class Fit(NamedTuple):
    """angles_rad: (T, 21) within the joint limits.  error_m: (T, 20) distance joint by joint."""

    angles_rad: Tensor
    error_m: Tensor


def shape_of_joints(joints_m: Tensor, shape: HandShape, yaw_rad: float = 0.0) -> HandShape:
    """`shape` with the palm and the bone lengths of one person's recorded joints.

    joints_m: (T, 5, 4, 3) metres, a right hand. Bones are medians over time; the fingers' roots are
    the mean of the frames aligned to the shape's own roots, turned by -yaw_rad in the plane of the
    palm. Rest directions stay, so that an angle means the same for every hand.
    """
    joints = joints_m.to(shape.base_m)
    bones = joints.diff(dim=2).norm(dim=-1).median(0).values
    roots = _in_hand_frame(joints, shape)[:, :, 0].mean(0)
    turn = roma.rotvec_to_rotmat(roots.new_tensor([0.0, 0.0, yaw_rad]))
    return replace(shape, base_m=roots @ turn, bone_lengths_m=bones)


def straight_finger_directions(joints_m: Tensor, shape: HandShape) -> Tensor:
    """How straight middle and ring fingers lie to their rest direction in the plane of the palm.

    Where a recording's own hand model has its knuckles says little about where it holds its
    fingers; atan2 of the sum of these vectors over all recordings of a sensor is the `yaw_rad`
    that makes straight fingers straight here.

    joints_m: (T, 5, 4, 3) metres, a right hand.  Returns (2,): sums of (sine, cosine), metres.
    """
    joints = joints_m.to(shape.base_m)
    fingers = _in_hand_frame(joints, shape)[:, 2:4]
    length = joints.diff(dim=2)[:, 2:4].norm(dim=-1).sum(-1)
    chord = fingers[:, :, -1] - fingers[:, :, 0]
    straight = chord.norm(dim=-1) > _STRAIGHT * length
    rest = -shape.base_frames[2:4, :, 1]
    sine = rest[:, 0] * chord[..., 1] - rest[:, 1] * chord[..., 0]
    cosine = rest[:, 0] * chord[..., 0] + rest[:, 1] * chord[..., 1]
    return torch.stack((sine[straight].sum(), cosine[straight].sum()))


def _in_hand_frame(joints: Tensor, shape: HandShape) -> Tensor:
    """Joints (T, 5, 4, 3) with their roots aligned to the shape's, scaled to the bones' size."""
    bones = joints.diff(dim=2).norm(dim=-1).median(0).values
    scale = bones.sum() / shape.bone_lengths_m.sum()
    rotation, translation = _align(shape.base_m * scale, joints[:, :, 0])
    return (joints - translation[:, None, None]) @ rotation[:, None]


def fit_angles(
    joints_m: Tensor, shape: HandShape, iterations: int = 20, prior: float = 1e-3
) -> Fit:
    """Joint angles whose skeleton comes nearest to the recorded joints, frame by frame.

    1. Align the finger roots rigidly (Kabsch) and carry the joints into the hand frame, so that
       the six global degrees of freedom start near zero.
    2. Repeat: J = d joints / d state, (T, 60, 27), every column axis x (joint - origin);
       solve (J'J + damping + prior) step = J'r - prior angles; project on the limits;
       keep the step and loosen the damping where the error fell, else tighten it.

    joints_m: (T, 5, 4, 3) metres, fingers from the thumb, each from its root to its tip, of a
        right hand; finite.
    shape: a right hand of the recorded person's size.
    prior: pull of every angle towards rest, per rad^2; it only decides what the joints leave open,
        such as turning a straight finger about itself.
    """
    shape = shape.to(torch.float64)
    joints = joints_m.double()
    rotation, translation = _align(shape.base_m, joints[:, :, 0])
    target = (joints.flatten(1, 2) - translation[:, None]) @ rotation
    limits = target.new_tensor(ANGLE_LIMITS)
    low = torch.cat((limits.new_full((6,), -10.0), limits[:, 0]))
    high = torch.cat((limits.new_full((6,), 10.0), limits[:, 1]))
    pull = torch.cat((target.new_zeros(6), target.new_full((21,), prior)))

    def evaluate(state: Tensor) -> tuple[HandPose, Tensor, Tensor]:
        pose = forward_kinematics(state, shape)
        residual = ((target - pose.joints_m[:, 1:]) / _UNIT_M).flatten(1)
        return pose, residual, residual.square().sum(1) + (pull * state.square()).sum(1)

    state = target.new_zeros(len(target), 27)
    damping = target.new_full((len(target), 1), 1e-2)
    pose, residual, value = evaluate(state)
    for _ in range(iterations):
        jacobian = joint_jacobian(pose, shape) / _UNIT_M
        normal = jacobian.mT @ jacobian + torch.diag_embed(damping + pull)
        right = (jacobian.mT @ residual[..., None])[..., 0] - pull * state
        # A coordinate that rests on its limit and is pushed outwards stays there this step.
        stuck = ((state <= low) & (right < 0)) | ((state >= high) & (right > 0))
        normal = normal.masked_fill(stuck[:, None] | stuck[..., None], 0.0)
        normal = normal + torch.diag_embed(stuck.double())
        step = torch.linalg.solve(normal, right.masked_fill(stuck, 0.0))
        turned = roma.rotvec_composition((step[:, 3:6], state[:, 3:6]))
        moved = torch.cat((state[:, :3] + step[:, :3], turned, state[:, 6:] + step[:, 6:]), 1)
        moved = torch.minimum(torch.maximum(moved, low), high)
        new_pose, new_residual, new_value = evaluate(moved)
        better = new_value < value
        state = torch.where(better[:, None], moved, state)
        residual = torch.where(better[:, None], new_residual, residual)
        value = torch.where(better, new_value, value)
        pose = HandPose(
            *(
                torch.where(better.view(-1, *[1] * (old.dim() - 1)), new, old)
                for new, old in zip(new_pose, pose, strict=True)
            )
        )
        damping = torch.where(better[:, None], damping / 3, damping * 4).clamp(1e-6, 1e6)
    error = (target - pose.joints_m[:, 1:]).norm(dim=-1)
    return Fit(state[:, 6:], error)


def joint_jacobian(pose: HandPose, shape: HandShape) -> Tensor:
    """Derivatives of the 20 finger joints by the 27 degrees of freedom of right hands.

    A turn about an axis through an origin moves a joint by axis x (joint - origin); see SLOT_BONES.
    The three global rotations are about the camera's axes.

    Returns (T, 60, 27), metres per metre or radian.
    """
    joints = pose.joints_m[:, 1:]
    bones = pose.frames[:, 1:].unflatten(1, (5, 3))  # (T, 5, 3, 3, 3)
    origins = pose.origins_m[:, 1:].unflatten(1, (5, 3))
    rest_z = (pose.frames[:, :1] @ shape.base_frames)[..., 2]  # (T, 5, 3)
    axes = torch.stack(
        (rest_z, bones[:, :, 0, :, 0], bones[:, :, 0, :, 2], *bones[:, :, 1:, :, 0].unbind(2)), 2
    )  # (T, 5, 5 slots, 3)
    slots = list(CHAIN_SLOTS)
    through = origins[:, :, SLOT_BONES].flatten(1, 2)[:, slots]
    lever = joints[:, :, None] - through[:, None]  # (T, 20, 21, 3)
    moves = torch.linalg.cross(axes.flatten(1, 2)[:, None, slots].expand_as(lever), lever)
    moves = moves * moves.new_tensor(JOINT_MOVES[1:])[..., None]
    from_wrist = (joints - pose.joints_m[:, :1])[:, :, None]
    eye = torch.eye(3, dtype=joints.dtype, device=joints.device).expand(*joints.shape, 3)
    turns = torch.linalg.cross(eye, from_wrist.expand_as(eye))
    return torch.cat((eye, turns, moves), 2).mT.flatten(1, 2)


def _align(roots: Tensor, joints: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation (T, 3, 3) and translation (T, 3) that carry roots (5, 3) to joints (T, 5, 3)."""
    weights = joints.new_tensor(_ROOT_WEIGHTS).expand(joints.shape[:2])
    return roma.rigid_points_registration(roots.expand_as(joints), joints, weights)
