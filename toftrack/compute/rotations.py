"""Rotation vectors, matrices and unit quaternions (x, y, z, w), any leading axes, differentiable.

What the tracker uses of roma (https://github.com/naver/roma), with its formulas and to the same
bits: roma itself loads torch's compiler, which takes longer than everything else at a start.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

_SMALL_RAD = 1e-6


def rotvec_to_rotmat(rotvec: Tensor) -> Tensor:
    """(..., 3) radians to (..., 3, 3), by Rodrigues' formula."""
    angle = torch.norm(rotvec, dim=-1)
    axis = rotvec / torch.clamp_min(angle[..., None], _SMALL_RAD)
    turned = _rodrigues(axis, torch.sin(angle), 1 - torch.cos(angle))
    near = _rodrigues(rotvec, torch.ones_like(angle), torch.zeros_like(angle))
    return torch.where((angle < _SMALL_RAD)[..., None, None], near, turned)


def _rodrigues(axis: Tensor, sine: Tensor, rest: Tensor) -> Tensor:
    """rest: one less the cosine."""
    x, y, z = axis.unbind(-1)
    xs, ys, zs = x * sine, y * sine, z * sine
    xy, xz, yz = x * y * rest, x * z * rest, y * z * rest
    xx, yy, zz = x**2 * rest, y**2 * rest, z**2 * rest
    rows = (
        *(1 - yy - zz, xy - zs, xz + ys),
        *(xy + zs, 1 - xx - zz, -xs + yz),
        *(xz - ys, xs + yz, 1 - xx - yy),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def rotmat_to_rotvec(matrix: Tensor) -> Tensor:
    """(..., 3, 3) to (..., 3) radians, of length 0 .. pi."""
    return unitquat_to_rotvec(_rotmat_to_unitquat(matrix))


def rotvec_composition(*rotvecs: Tensor) -> Tensor:
    """Rotation vectors (..., 3) of turning by the last first, and by the first last."""
    return unitquat_to_rotvec(functools.reduce(_product, map(_rotvec_to_unitquat, rotvecs)))


def _product(p: Tensor, q: Tensor) -> Tensor:
    p, q = torch.broadcast_tensors(p, q)
    cross = torch.cross(p[..., :3], q[..., :3], dim=-1)
    vector = p[..., None, 3] * q[..., :3] + q[..., None, 3] * p[..., :3] + cross
    last = p[..., 3] * q[..., 3] - torch.sum(p[..., :3] * q[..., :3], dim=-1)
    return torch.cat((vector, last[..., None]), -1)


def unitquat_to_rotvec(quaternion: Tensor) -> Tensor:
    """(..., 4) to (..., 3) radians, of length 0 .. pi."""
    sign = (quaternion[..., 3] > 0).to(quaternion.dtype) * 2.0 - 1.0
    quaternion = quaternion * sign[..., None]
    half = torch.atan2(torch.norm(quaternion[..., :3], dim=-1), quaternion[..., 3])
    small = _is_small(half)
    sine = torch.where(small, torch.ones_like(half), torch.sin(half))
    factor = torch.where(small, 1 + half**2 / 6 + 7 * half**4 / 360, half / sine)
    return (2.0 * factor)[..., None] * quaternion[..., :3]


def unitquat_to_rotmat(quaternion: Tensor) -> Tensor:
    """(..., 4) to (..., 3, 3)."""
    x, y, z, w = quaternion.unbind(-1)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def special_gramschmidt(matrix: Tensor) -> Tensor:
    """(..., 3, 2) or more columns to the rotations (..., 3, 3) that the first two span."""
    x, y = matrix[..., 0], matrix[..., 1]
    x = x / torch.norm(x, dim=-1, keepdim=True)
    y = y - torch.sum(x * y, dim=-1, keepdim=True) * x
    y = y / torch.norm(y, dim=-1, keepdim=True)
    return torch.stack((x, y, torch.cross(x, y, dim=-1)), -1)


def _rotvec_to_unitquat(rotvec: Tensor) -> Tensor:
    half = torch.norm(rotvec, dim=-1) / 2
    small = _is_small(half)
    series = 1 - half**2 / 6 + half**4 / 120
    ratio = torch.where(small, series, torch.sin(half) / torch.where(small, 1.0, half))
    return torch.cat(((ratio / 2.0)[..., None] * rotvec, torch.cos(half)[..., None]), -1)


def _is_small(angle: Tensor) -> Tensor:
    """Where sines are divided by their arguments as series, because the derivative wants it."""
    return torch.abs(angle) < 2 * torch.finfo(angle.dtype).eps ** (1 / 6)


def _rotmat_to_unitquat(matrix: Tensor) -> Tensor:
    """By the largest component (Markley, J. Guidance, Control, and Dynamics 31(2), 2008)."""
    rows = (row.unbind(-1) for row in matrix.mT.unbind(-2))
    (a11, a12, a13), (a21, a22, a23), (a31, a32, a33) = rows
    products = (
        *(1 + a11 - a22 - a33, a12 + a21, a13 + a31, a23 - a32),
        *(a21 + a12, 1 + a22 - a33 - a11, a23 + a32, a31 - a13),
        *(a31 + a13, a32 + a23, 1 + a33 - a11 - a22, a12 - a21),
        *(a23 - a32, a31 - a13, a12 - a21, 1 + a11 + a22 + a33),
    )
    found = torch.stack(products, -1).unflatten(-1, (4, 4))
    largest = found.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    row = largest[..., None, None].expand(*largest.shape, 1, 4)
    chosen = torch.gather(found, -2, row)[..., 0, :]
    return chosen / torch.norm(chosen, dim=-1, keepdim=True)


def rotation_matrix(rotvec: np.ndarray) -> np.ndarray:
    """(3, 3) of one rotation vector (3,), radians; the same as rotvec_to_rotmat."""
    angle = float(np.sqrt(np.square(rotvec).sum()))
    x, y, z = np.asarray(rotvec, np.float64) / max(angle, 1e-12)
    turn = np.array(((0, -z, y), (z, 0, -x), (-y, x, 0)))
    matrix: np.ndarray = np.eye(3) + math.sin(angle) * turn + (1 - math.cos(angle)) * turn @ turn
    return matrix
