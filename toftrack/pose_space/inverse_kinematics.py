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
from torch.autograd import forward_ad

from toftrack.errors import ToftrackError
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import ANGLE_LIMITS, forward_kinematics

_BASES = (0, 4, 8, 12, 16)
"""Rows of the thumb's CMC joint and of the four knuckles among 20 finger joints."""


class Fit(NamedTuple):
    """angles_rad: (T, 21) within the joint limits.  error_m: (T, 20) distance joint by joint."""

    angles_rad: Tensor
    error_m: Tensor


def shape_of_joints(joints_m: Tensor, shape: HandShape) -> HandShape:
    """`shape` with the palm and the bone lengths of one person's recorded joints.

    joints_m: (T, 5, 4, 3) metres, a right hand. Bones are the medians over time; the roots of the
    fingers are the mean of the frames aligned to the shape's own roots. The fingers' rest
    directions stay, so that an angle means the same for every hand.
    """
    joints = joints_m.to(shape.base_m)
    bones = joints.diff(dim=2).norm(dim=-1).median(0).values
    scale = bones.sum() / shape.bone_lengths_m.sum()
    roots = joints[:, :, 0]
    rotation, translation = _align(shape.base_m * scale, roots)
    back = (roots - translation[:, None]) @ rotation  # R' (x - t), rows
    return replace(shape, base_m=back.mean(0), bone_lengths_m=bones)


def fit_angles(
    joints_m: Tensor, shape: HandShape, iterations: int = 30, prior: float = 1e-3
) -> Fit:
    """Joint angles whose skeleton comes nearest to the recorded joints, frame by frame.

    1. Align the finger roots rigidly (Kabsch) and carry the joints into the hand frame.
    2. Repeat: J = d joints / d state by forward differentiation, 27 directions, all frames in one
       batch; solve (J'J + (damping + prior) I) step = J'r - prior * angles; project on the limits;
       keep the step and loosen the damping where the error fell, else tighten it.

    joints_m: (T, 5, 4, 3) metres, fingers from the thumb, each from its root to its tip; right
        hand.
    shape: a right hand of the recorded person's size.
    prior: pull of every angle towards rest, m^2/rad^2 in units of (1e-2 m)^2; it only decides what
        the joints leave open, such as turning a straight finger about itself.

    Raises ToftrackError for other shapes of the input or for values that are not finite.
    """
    if joints_m.dim() != 4 or joints_m.shape[1:] != (5, 4, 3) or len(joints_m) == 0:
        raise ToftrackError(
            f"joints of the shape {tuple(joints_m.shape)} are not (frames, 5 fingers, 4 joints, 3)"
        )
    if not bool(joints_m.isfinite().all()):
        raise ToftrackError("joint positions must be finite numbers, without NaN")
    shape = shape.to(torch.float64)
    joints = joints_m.double()
    rotation, translation = _align(shape.base_m, joints[:, :, 0])
    target = ((joints.flatten(1, 2) - translation[:, None]) @ rotation).flatten(1)
    limits = target.new_tensor(ANGLE_LIMITS)
    low = torch.cat((limits.new_full((6,), -10.0), limits[:, 0]))
    high = torch.cat((limits.new_full((6,), 10.0), limits[:, 1]))
    unit = 1e-2  # m: residuals near one, so that damping and prior are without scale

    def joints_of(state: Tensor) -> Tensor:
        return forward_kinematics(state, shape).joints_m[:, 1:].flatten(1)

    def cost(state: Tensor) -> Tensor:
        residual = (joints_of(state) - target) / unit
        return residual.square().sum(1) + prior * state[:, 6:].square().sum(1)

    state = target.new_zeros(len(target), 27)
    damping = target.new_full((len(target), 1), 1e-2)
    pull = torch.cat((target.new_zeros(6), target.new_full((21,), prior)))
    value = cost(state)
    for _ in range(iterations):
        jacobian = _jacobian(joints_of, state) / unit
        residual = (target - joints_of(state)) / unit
        normal = jacobian.mT @ jacobian + torch.diag_embed(damping + pull)
        right = (jacobian.mT @ residual[..., None])[..., 0] - pull * state
        # A coordinate that rests on its limit and is pushed outwards stays there this step.
        stuck = ((state <= low) & (right < 0)) | ((state >= high) & (right > 0))
        normal = normal.masked_fill(stuck[:, None] | stuck[..., None], 0.0)
        normal = normal + torch.diag_embed(stuck.double())
        step = torch.linalg.solve(normal, right.masked_fill(stuck, 0.0))
        moved = torch.minimum(torch.maximum(state + step, low), high)
        new = cost(moved)
        better = new < value
        state = torch.where(better[:, None], moved, state)
        value = torch.where(better, new, value)
        damping = torch.where(better[:, None], damping / 3, damping * 4).clamp(1e-6, 1e6)
    error = (joints_of(state) - target).unflatten(1, (20, 3)).norm(dim=-1)
    return Fit(state[:, 6:], error)


def _align(roots: Tensor, joints: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation (T, 3, 3) and translation (T, 3) that carry roots (5, 3) to joints (T, 5, 3)."""
    expanded = roots.expand_as(joints)
    return roma.rigid_points_registration(expanded, joints)


def _jacobian(function, state: Tensor) -> Tensor:  # noqa: ANN001
    """(T, m, 27) derivatives of a row-wise function (T, 27) -> (T, m), one column at a time."""
    columns = []
    for index in range(state.shape[1]):
        direction = torch.zeros_like(state)
        direction[:, index] = 1.0
        with forward_ad.dual_level():
            value = function(forward_ad.make_dual(state, direction))
            columns.append(forward_ad.unpack_dual(value).tangent)
    return torch.stack(columns, -1)
