"""Rigid motions of particles on a CUDA device, one kernel each, instead of a hundred operations.

The same formulas as in rigid_numba.py, in float32, a lane to a particle.
"""

from __future__ import annotations

from functools import partial

import torch
import triton
import triton.language as tl
from torch import Tensor

from toftrack.compute import rigid
from toftrack.compute.rigid import PIVOT_M, Motions

_BLOCK = 64


@triton.jit
def _arc(sine, cosine):
    """The angle, 0 .. pi / 2, of a sine and a cosine that are not negative, up to a factor."""
    low, high = tl.minimum(sine, cosine), tl.maximum(sine, cosine)
    part = low / tl.maximum(high, 1e-30)
    far = part > 0.41421356
    x = tl.where(far, (part - 1.0) / (part + 1.0), part)
    z = x * x
    # Cephes' atanf (Moshier): no triton has an arc tangent that its interpreter knows.
    series = ((0.0805374449538 * z - 0.138776856032) * z + 0.199777106478) * z - 0.333329491539
    angle = series * z * x + x + tl.where(far, 0.78539816, 0.0)
    return tl.where(sine > cosine, 1.57079633 - angle, angle)


@triton.jit
def _quaternion(a, b, c):
    """Of a rotation vector, radians."""
    square = a * a + b * b + c * c
    angle = tl.sqrt(square)
    factor = tl.sin(0.5 * angle) / tl.maximum(angle, 1e-6)
    factor = tl.where(angle > 1e-6, factor, 0.5 - square / 48.0)
    return factor * a, factor * b, factor * c, tl.cos(0.5 * angle)


@triton.jit
def _product(px, py, pz, pw, qx, qy, qz, qw):
    """Of two quaternions: first q turns, then p."""
    return (
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
        pw * qw - px * qx - py * qy - pz * qz,
    )


@triton.jit
def _rotation_vector(x, y, z, w):
    """Of a unit quaternion, radians, of length 0 .. pi."""
    sign = tl.where(w < 0, -1.0, 1.0)
    sine = tl.sqrt(x * x + y * y + z * z)
    # At a small angle, 2 atan(sine / cosine) / sine is 2 / cosine.
    factor = sign * tl.where(sine > 1e-6, 2.0 * _arc(sine, sign * w) / tl.maximum(sine, 1e-6), 2.0)
    return factor * x, factor * y, factor * z


@triton.jit
def _turned(x, y, z, w, u, v, s):
    """A vector (u, v, s) turned by a unit quaternion."""
    a, b, c = y * s - z * v, z * u - x * s, x * v - y * u
    return (
        u + 2 * (w * a + y * c - z * b),
        v + 2 * (w * b + z * a - x * c),
        s + 2 * (w * c + x * b - y * a),
    )


@triton.jit
def _pose(row, inside):
    """Translation and quaternion of a particle or of an offset."""
    x = tl.load(row, mask=inside, other=0.0)
    y = tl.load(row + 1, mask=inside, other=0.0)
    z = tl.load(row + 2, mask=inside, other=0.0)
    a = tl.load(row + 3, mask=inside, other=0.0)
    b = tl.load(row + 4, mask=inside, other=0.0)
    c = tl.load(row + 5, mask=inside, other=0.0)
    qx, qy, qz, qw = _quaternion(a, b, c)
    return x, y, z, qx, qy, qz, qw


@triton.jit
def _write(to, inside, x, y, z, qx, qy, qz, qw):
    a, b, c = _rotation_vector(qx, qy, qz, qw)
    tl.store(to, x, mask=inside)
    tl.store(to + 1, y, mask=inside)
    tl.store(to + 2, z, mask=inside)
    tl.store(to + 3, a, mask=inside)
    tl.store(to + 4, b, mask=inside)
    tl.store(to + 5, c, mask=inside)


@triton.jit
def compose_kernel(
    reference, tangent, out, n, size, reference_step, tangent_step, u, v, s, BLOCK: tl.constexpr
):
    """Particles (N, size) at tangent offsets from others; a step of 0 is one row for all.

    u, v, s: the pivot.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    at = i.to(tl.int64)
    r, t, to = reference + at * reference_step, tangent + at * tangent_step, out + at * size
    x, y, z, qx, qy, qz, qw = _pose(r, inside)
    tx, ty, tz, px, py, pz, pw = _pose(t, inside)
    px, py, pz, pw = _product(px, py, pz, pw, qx, qy, qz, qw)
    old_u, old_v, old_s = _turned(qx, qy, qz, qw, u, v, s)
    new_u, new_v, new_s = _turned(px, py, pz, pw, u, v, s)
    x, y, z = x + tx + old_u - new_u, y + ty + old_v - new_v, z + tz + old_s - new_s
    _write(to, inside, x, y, z, px, py, pz, pw)
    for j in range(6, size):
        sum_ = tl.load(r + j, mask=inside, other=0.0) + tl.load(t + j, mask=inside, other=0.0)
        tl.store(to + j, sum_, mask=inside)


@triton.jit
def difference_kernel(particles, reference, out, n, size, u, v, s, BLOCK: tl.constexpr):
    """Tangent offsets (N, size) of particles from one other, see compose_kernel."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    at = i.to(tl.int64)
    p, r, to = particles + at * size, reference + at * 0, out + at * size
    x, y, z, px, py, pz, pw = _pose(p, inside)
    rx, ry, rz, qx, qy, qz, qw = _pose(r, inside)
    old_u, old_v, old_s = _turned(qx, qy, qz, qw, u, v, s)
    new_u, new_v, new_s = _turned(px, py, pz, pw, u, v, s)
    px, py, pz, pw = _product(px, py, pz, pw, -qx, -qy, -qz, qw)
    x, y, z = x - rx + new_u - old_u, y - ry + new_v - old_v, z - rz + new_s - old_s
    _write(to, inside, x, y, z, px, py, pz, pw)
    for j in range(6, size):
        off = tl.load(p + j, mask=inside, other=0.0) - tl.load(r + j, mask=inside, other=0.0)
        tl.store(to + j, off, mask=inside)


def compose(reference: Tensor, tangent: Tensor) -> Tensor:
    """See rigid.compose."""
    n, size = max(len(reference), len(tangent)), reference.shape[1]
    rows = [given.float().contiguous() for given in (reference, tangent)]
    steps = [size if len(given) > 1 else 0 for given in rows]
    out = torch.empty(n, size, device=reference.device)
    grid = (triton.cdiv(n, _BLOCK),)
    compose_kernel[grid](*rows, out, n, size, *steps, *PIVOT_M, BLOCK=_BLOCK)
    return out


def difference(particles: Tensor, reference: Tensor) -> Tensor:
    """See rigid.difference."""
    n, size = particles.shape
    rows = [given.float().contiguous() for given in (particles, reference)]
    out = torch.empty(n, size, device=particles.device)
    grid = (triton.cdiv(n, _BLOCK),)
    difference_kernel[grid](*rows, out, n, size, *PIVOT_M, BLOCK=_BLOCK)
    return out


MOTIONS = Motions(compose, difference, partial(rigid.redraw, compose), rigid.mean)
"""Of particles on a CUDA device."""
