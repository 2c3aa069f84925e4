"""Rigid motions of particles in plain torch, the reference: offsets, their sum, mean rotations.

A particle is a row of an (N, 6 + d) tensor: the wrist's translation (3, m), rotation vector
(3, rad) and d further coordinates, which are simply added.

Differences between particles are taken in the tangent space of a reference: translation of the
pivot, rotation vector of R R_ref', difference of the rest. The pivot is a point in the middle of
the hand, so that turning the hand does not also carry it away, as turning about the wrist would.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.redraw import Motions, redraw_with
from toftrack.compute.rotations import rotvec_composition, unitquat_to_rotvec
from toftrack.compute.transfer import on_host, table

PIVOT_M = (0.0, -0.085, 0.0)
"""The middle of the hand in the hand frame: near the knuckles of an adult hand."""
_X, _Y, _Z = PIVOT_M


def compose(reference: Tensor, tangent: Tensor) -> Tensor:
    """Particles at tangent offsets from reference particles; (N, 6 + d) or broadcast, each."""
    reference, tangent = torch.broadcast_tensors(reference, tangent)
    rotvec = rotvec_composition(tangent[:, 3:6], reference[:, 3:6])
    translation = _pivot(reference) + tangent[:, :3] - rotated_pivot(rotvec)
    return torch.cat((translation, rotvec, reference[:, 6:] + tangent[:, 6:]), 1)


def difference(particles: Tensor, reference: Tensor) -> Tensor:
    """Tangent offsets of particles from one reference, (N, 6 + d) and (1, 6 + d) to (N, 6 + d)."""
    inverse = -reference[:, 3:6].expand(len(particles), 3)
    turn = rotvec_composition(particles[:, 3:6], inverse)
    move = _pivot(particles) - _pivot(reference)
    return torch.cat((move, turn, particles[:, 6:] - reference[:, 6:]), 1)


def rotated_pivot(rotvec: Tensor) -> Tensor:
    """The pivot's offset from the wrist, by Rodrigues' formula, (N, 3) to (N, 3)."""
    p = table(PIVOT_M, rotvec.dtype, rotvec.device).expand_as(rotvec)
    square = rotvec.square().sum(1, keepdim=True)
    angle = square.clamp(min=1e-12).sqrt()
    cross = torch.linalg.cross(rotvec, p)
    along = torch.linalg.cross(rotvec, cross)
    return p + angle.sin() / angle * cross + (1 - angle.cos()) / angle.square() * along


def pivot_offset(rotvec: np.ndarray) -> np.ndarray:
    """The same on the CPU, (N, 3) to (N, 3), where torch's operations take longer than this."""
    out = np.empty_like(rotvec)
    for row, (a, b, c) in enumerate(rotvec.tolist()):
        square = max(a * a + b * b + c * c, 1e-12)
        angle = math.sqrt(square)
        first, second = math.sin(angle) / angle, (1 - math.cos(angle)) / square
        along = second * (a * _X + b * _Y + c * _Z)
        cosine = math.cos(angle)
        out[row, 0] = cosine * _X + first * (b * _Z - c * _Y) + a * along
        out[row, 1] = cosine * _Y + first * (c * _X - a * _Z) + b * along
        out[row, 2] = cosine * _Z + first * (a * _Y - b * _X) + c * along
    return out


def _pivot(particles: Tensor) -> Tensor:
    return particles[:, :3] + rotated_pivot(particles[:, 3:6])


def rotation_scatter(rotvec: Tensor, weights: Tensor) -> Tensor:
    """What `main_rotation` needs to know of (N, 3) rotations of (N,) weights, (4, 4) float64."""
    half = 0.5 * rotvec.double()
    angle = half.norm(dim=1, keepdim=True)
    q = torch.cat((half * (angle / torch.pi).sinc(), angle.cos()), 1)
    # The quaternion of the rotation nearest to the mean matrix (chordal L2 mean; Hartley et al.,
    # "Rotation averaging", IJCV 2013) is the main axis of all quaternions, whatever their signs
    # (Markley et al., JGCD 2007).
    return (q * weights[:, None]).mT @ q


def main_rotation(scatter: Tensor) -> Tensor:
    """The mean rotation (3,) of what `rotation_scatter` has summed up, float64.

    The rotation nearest to the mean matrix (chordal L2 mean; Hartley et al., "Rotation averaging",
    IJCV 2013).
    """
    return unitquat_to_rotvec(torch.linalg.eigh(scatter).eigenvectors[:, -1])


def mean(particles: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean, (N, 6 + d) and (N,) to (1, 6 + d) on the CPU, the rotation's on SO(3)."""
    found = (weights.to(particles.dtype) @ particles)[None]
    found, scatter = on_host(found, rotation_scatter(particles[:, 3:6], weights))
    found[0, 3:6] = main_rotation(scatter).to(found.dtype)
    return found


MOTIONS = Motions(compose, difference, redraw_with(compose), mean)
