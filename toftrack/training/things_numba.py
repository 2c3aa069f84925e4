"""Things in a depth picture: boxes, cones, rings and balls by signed distances.

Rays walk as far as nothing can be met ("sphere tracing", Hart, The Visual Computer 12(10), 1996).
"""

from __future__ import annotations

import math

import numpy as np

from toftrack.compute.compiling import compiled

BOX, CONE, RING, BALL = range(4)
"""Kinds of a thing's parts: half sizes along x, y and z; radii at the ends of y and half its
length; radii of a ring about z and of what it is made of; radius."""
PART = 19
"""Numbers of a part: kind, place (3), rows of the rotation into its own frame (9), sizes (3), the
radius of its edges, the thickness of its wall (above 0: a cone that is open at +y), the radius of a
ball about the place that holds it. A kind below 0 is no part."""
_STEPS, _BUNDLE_STEPS = 48, 16
TILE = 4
MIDDLE, CORNER = np.float32(1.5), np.float32(2.13)
"""Of a tile, pixels: its side, middle, and how far a corner is from that."""
_NEAR_M = np.float32(0.0004)


@compiled
def seen_between(x, z, xx, xz, zz, f, middle, size):
    """First and last pixel, along one axis, of an ellipsoid in front of the camera.

    x, z: its middle.  xx, xz, zz: of A A', where the columns of A are its half-axes.
    """
    w = 1 / (z * z - zz)
    at = (x * z - xz) * w
    half = math.sqrt(max(at * at - (x * x - xx) * w, 0.0))
    first = max(0, math.ceil((at - half) * f + middle))
    return first, min(size - 1, math.floor((at + half) * f + middle))


@compiled
def part_distance(part, x, y, z):
    """From a point to a thing's part, see PART; below 0 inside."""
    x, y, z = x - part[1], y - part[2], z - part[3]
    a = part[4] * x + part[5] * y + part[6] * z
    b = part[7] * x + part[8] * y + part[9] * z
    c = part[10] * x + part[11] * y + part[12] * z
    kind, edge = int(part[0]), part[16]
    if kind == BALL:
        return math.sqrt(a * a + b * b + c * c) - part[13]
    if kind == RING:
        across = math.sqrt(a * a + b * b) - part[13]
        return math.sqrt(across * across + c * c) - part[14]
    if kind == BOX:
        qa, qb = abs(a) - part[13] + edge, abs(b) - part[14] + edge
        qc = abs(c) - part[15] + edge
        oa, ob, oc = max(qa, 0.0), max(qb, 0.0), max(qc, 0.0)
        return math.sqrt(oa * oa + ob * ob + oc * oc) + min(max(qa, max(qb, qc)), 0.0) - edge
    across = math.sqrt(a * a + c * c)
    d = _frustum(across, b, part[13] - edge, part[14] - edge, part[15] - edge) - edge
    wall = part[17]
    if wall > 0:
        hollow = _frustum(across, b - 2 * wall, part[13] - wall, part[14] - wall, part[15] + wall)
        d = max(d, -hollow)
    return d


@compiled
def _frustum(across, y, first, second, half):
    """Of a flat-ended cone along y from -half to half, with radii `first` and `second` there."""
    flat = across - min(across, first if y < 0 else second)
    beyond = abs(y) - half
    step, rise = second - first, 2 * half
    t = ((second - across) * step + (half - y) * rise) / (step * step + rise * rise)
    t = min(max(t, 0.0), 1.0)
    sx, sy = across - second + step * t, y - half + rise * t
    sign = -1.0 if sx < 0 and beyond < 0 else 1.0
    return sign * math.sqrt(min(flat * flat + beyond * beyond, sx * sx + sy * sy))


@compiled
def draw_part(part, label, lens, depth, labels):
    """A thing's part into the depth buffer: first with the bundle of all rays of a tile, then with
    each of them, see skin_numba.
    """
    x0, y0, z0, r = part[1], part[2], part[3], part[18]
    if z0 - r < 0.05:
        return
    f = lens[0]
    square = r * r
    left, right = seen_between(x0, z0, square, np.float32(0), square, f, lens[1], int(lens[3]))
    top, bottom = seen_between(y0, z0, square, np.float32(0), square, f, lens[2], int(lens[4]))
    apart = CORNER / f
    for v0 in range(top, bottom + 1, TILE):
        for u0 in range(left, right + 1, TILE):
            y = (np.float32(v0) + MIDDLE - lens[2]) / f
            x = (np.float32(u0) + MIDDLE - lens[1]) / f
            before, last = _through_ball(x, y, x0, y0, z0, r + apart * (z0 + r))
            norm = math.sqrt(x * x + y * y + 1)
            for _ in range(_BUNDLE_STEPS):
                free = part_distance(part, before * x, before * y, before) - apart * before
                if free < _NEAR_M or before > last:
                    break
                before += free / norm
            if before > last:
                continue
            for v in range(v0, min(v0 + TILE, bottom + 1)):
                for u in range(u0, min(u0 + TILE, right + 1)):
                    x, y = (np.float32(u) - lens[1]) / f, (np.float32(v) - lens[2]) / f
                    z, last = _through_ball(x, y, x0, y0, z0, r)
                    norm = math.sqrt(x * x + y * y + 1)
                    z = max(z, before)
                    for _ in range(_STEPS):
                        if z > last or z >= depth[v, u]:
                            break
                        d = part_distance(part, z * x, z * y, z)
                        if d < _NEAR_M:
                            depth[v, u] = z
                            labels[v, u] = label
                            break
                        z += max(d, 0.0002) / norm


@compiled
def _through_ball(x, y, x0, y0, z0, r):
    """Z where the ray z (x, y, 1) comes into a ball, and where it leaves; (9, 0) if it misses."""
    square = x * x + y * y + 1
    b = x * x0 + y * y0 + z0
    disc = b * b - square * (x0 * x0 + y0 * y0 + z0 * z0 - r * r)
    if disc <= 0:
        return 9.0, 0.0
    root = math.sqrt(disc)
    return (b - root) / square, (b + root) / square
