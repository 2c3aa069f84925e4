"""How particles are moved, and drawn anew by their weights, in plain torch, the reference.

A particle is a row of an (N, 6 + d) tensor: the wrist's translation (3, m), rotation vector
(3, rad) and d further coordinates, which are simply added.

Differences between particles are taken in the tangent space of a reference: translation of the
pivot, rotation vector of R R_ref', difference of the rest. The pivot is a point in the middle of
the hand, so that turning the hand does not also carry it away, as turning about the wrist would.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.rotations import rotvec_composition, unitquat_to_rotvec
from toftrack.compute.transfer import on_host, table

PIVOT_M = (0.0, -0.085, 0.0)
"""The middle of the hand in the hand frame: near the knuckles of an adult hand."""
_X, _Y, _Z = PIVOT_M
BOUNDS = ("truncate", "reflect")
LEAST_WIDTH = 1e-30
"""What a box is taken to be wide at least where coordinates are folded back into it."""
Redraw = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, str], Tensor]
"""See `redraw`, without the motion."""


class Motions(NamedTuple):
    """The operations that every back end has.

    compose: reference particles and tangent offsets, (N, 6 + d) or broadcast, to particles.
    difference: particles (N, 6 + d) and one reference (1, 6 + d) to tangent offsets (N, 6 + d).
    redraw: particles anew from weighted ones.
    mean: particles (N, 6 + d) and weights (N,) to their mean (1, 6 + d), which is on the CPU.
    """

    compose: Callable[[Tensor, Tensor], Tensor]
    difference: Callable[[Tensor, Tensor], Tensor]
    redraw: Redraw
    mean: Callable[[Tensor, Tensor], Tensor]


def compose(reference: Tensor, tangent: Tensor) -> Tensor:
    """See Motions."""
    reference, tangent = torch.broadcast_tensors(reference, tangent)
    rotvec = rotvec_composition(tangent[:, 3:6], reference[:, 3:6])
    translation = _pivot(reference) + tangent[:, :3] - rotated_pivot(rotvec)
    return torch.cat((translation, rotvec, reference[:, 6:] + tangent[:, 6:]), 1)


def difference(particles: Tensor, reference: Tensor) -> Tensor:
    """See Motions."""
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


def mean(particles: Tensor, weights: Tensor) -> Tensor:
    """See Motions; the rotation's on SO(3).

    That is the one nearest to the mean matrix (chordal L2 mean; Hartley et al., "Rotation
    averaging", IJCV 2013), whose quaternion is the main axis of all quaternions, whatever their
    signs (Markley et al., JGCD 2007).
    """
    found = (weights.to(particles.dtype) @ particles)[None]
    half = 0.5 * particles[:, 3:6].double()
    angle = half.norm(dim=1, keepdim=True)
    q = torch.cat((half * (angle / torch.pi).sinc(), angle.cos()), 1)
    found, scatter = on_host(found, (q * weights[:, None]).mT @ q)
    main = torch.linalg.eigh(scatter).eigenvectors[:, -1]
    found[0, 3:6] = unitquat_to_rotvec(main).to(found.dtype)
    return found


def pick(weights: Tensor, positions: Tensor) -> Tensor:
    """Which of M weighted particles lie at positions, (M,) and (n,) ascending to (n,) int64.

    positions: in 0 .. 1, of the sum of the weights.
    """
    total = weights.double().cumsum(0)
    # Relative to the sum that was really reached, so that rounding cannot leave a gap at the end.
    indices = torch.searchsorted(total, positions * total[-1], right=True)
    # The last index that has weight: one past the end is only ever a rounding.
    last = torch.searchsorted(total, total[-1:])
    return torch.minimum(indices, last)


def bound(latent: Tensor, lower: Tensor, upper: Tensor, mode: str) -> Tensor:
    """Keep latent coordinates in their box, (N, d).

    mode: of BOUNDS. "truncate" moves what is outside onto the bound, as the paper, which draws
        estimates near a bound away from where they should be and piles particles up on it;
        "reflect" folds it back.
    """
    if mode == "truncate":
        return torch.minimum(torch.maximum(latent, lower), upper)
    # A coordinate that all training poses share has no width, by which nothing can be divided.
    there_and_back = (2 * (upper - lower)).clamp(min=LEAST_WIDTH)
    folded = torch.remainder(latent - lower, there_and_back)
    return lower + torch.minimum(folded, there_and_back - folded)


def redraw(
    compose: Callable[[Tensor, Tensor], Tensor],
    particles: Tensor,
    weights: Tensor,
    positions: Tensor,
    tangents: Tensor,
    lower: Tensor,
    upper: Tensor,
    mode: str,
) -> Tensor:
    """(M, 6 + d) particles of weights (M,) at positions (n,), moved (paper, section 2.3) by a
    motion, see Motions: (n, 6 + d).

    positions, lower, upper, mode: see pick and bound.  tangents: (n, 6 + d) of the moves.
    """
    moved = compose(particles[pick(weights, positions)], tangents)
    moved[:, 6:] = bound(moved[:, 6:], lower, upper, mode)
    return moved


MOTIONS = Motions(compose, difference, partial(redraw, compose), mean)
