"""Kinematics and conics of the CPU kernel: from states of 27 numbers to what a renderer draws.

A projective map takes ellipsoids to ellipsoids, so in (column, row, inverse depth) an ellipsoid
{c + F u : |u| <= 1} with S = F F' is again one. With w = c_z^2 - S_zz, its centre and "covariance"
are

    x0 = (c_x c_z - S_xz) / w,   u0 = c_z / w,          (y as x)
    K_xx = (S_xx c_z^2 - 2 S_xz c_x c_z + S_zz c_x^2 - S_xx S_zz + S_xz^2) / w^2,
    K_xu = (S_zz c_x - S_xz c_z) / w^2,   K_uu = S_zz / w^2,

without an inverse and without cancellation. Eliminating row, column and inverse depth in this
order (K = L D L') yields the rows, the exact span of columns in a row, and the near surface

    u = u0 + L_uy dy + L_ux t + sqrt(D_u (1 - dy^2 / D_y - t^2 / D_x)),   t = dx - L_xy dy.

This is the form of reference.py in other coordinates."""

from __future__ import annotations

import math

import numpy as np

from toftrack.compute.compiling import compiled
from toftrack.render.numba.vector import (
    BLOCK,
    down,
    larger,
    load,
    root,
    smaller,
    splat,
    store,
    up,
    where_above,
)
from toftrack.render.scoring import NEAREST_M

LANES = BLOCK
"""Particles whose kinematics are computed side by side, one to a SIMD lane; a task of a thread."""
_NEAREST = np.float32(NEAREST_M)
_ZERO, _HALF, _ONE, _TWO = (np.float32(number) for number in (0, 0.5, 1, 2))
_LARGEST = np.float32(1e9)
# Rows of the table of coefficients of an ellipsoid.
X, Y, U, HY, IY, XY, DX, UY, UX, DU, TERMS = range(11)
LEFT, TOP, RIGHT, BOTTOM = range(4)


@compiled
def _sin_cos(x):
    """Float32 sine and cosine (Cephes' polynomials) of a vector."""
    rotations = down(x * np.float32(2 / math.pi) + _HALF)
    r = x - rotations * np.float32(1.5703125)
    r = r - rotations * np.float32(4.837512969970703125e-4)
    r = r - rotations * np.float32(7.54978995489188216e-8)
    s = r * r
    sine = np.float32(-1.9515295891e-4) * s + np.float32(8.3321608736e-3)
    sine = (sine * s - np.float32(1.6666654611e-1)) * s * r + r
    cosine = np.float32(2.443315711809948e-5) * s - np.float32(1.388731625493765e-3)
    cosine = (cosine * s + np.float32(4.166664568298827e-2)) * s * s - _HALF * s
    cosine = cosine + _ONE
    # The quarter of the circle, 0 .. 3; in the odd ones they change places.
    quarter = rotations - np.float32(4.0) * down(rotations * np.float32(0.25))
    odd = (quarter - _TWO) * (quarter - _TWO) - _ONE
    odd = _HALF - odd * odd
    a, b = where_above(odd, cosine, sine), where_above(odd, sine, cosine)
    middle = quarter - np.float32(1.5)
    a = where_above(middle, splat(_ZERO) - a, a)
    return a, where_above(_ONE - middle * middle, splat(_ZERO) - b, b)


@compiled
def pose_hands(states, first, slots, base, lengths, mirror, x, frames, valid):
    """Frames of LANES hands from states[first:], see skeleton.forward_kinematics.

    x: (27 * LANES,) scratch.  frames: (16, 12 * LANES), rotation by rows and origin.
    valid: (LANES,), 0 for states that are not finite or past the end, whose frames are those of the
    zero state.
    """
    for i in range(LANES):
        row, check = first + i, np.float32(np.inf)
        if row < states.shape[0]:
            check = _ZERO
            for j in range(27):
                value = states[row, j]
                check += abs(value)
                x[j * LANES + i] = value
        valid[i] = check < _LARGEST
        if not valid[i]:
            for j in range(27):
                x[j * LANES + i] = _ZERO
    hand = _hand_frame(x, mirror)
    _keep(frames[0], hand)
    for finger in range(5):
        # The angles' slots are abduction, flexion, abduction, flexion, flexion.
        slot, to, bone, b = 5 * finger, 1 + 3 * finger, lengths[finger], base[finger]
        rest = _sum(hand, b[:, 0]), _sum(hand, b[:, 1]), _sum(hand, b[:, 2])
        frame = _turned(
            *rest, _moved(_sum(hand, b[:, 3]), hand[3]), x, slots[slot], slots[slot + 1]
        )
        _keep(frames[to], frame)
        frame = _turned(*_followed(frame, bone[0]), x, slots[slot + 2], slots[slot + 3])
        _keep(frames[to + 1], frame)
        _keep(frames[to + 2], _turned(*_followed(frame, bone[1]), x, -1, slots[slot + 4]))


@compiled
def _keep(to, frame):
    a, b, c, at = frame
    for i in range(3):
        store(to, 3 * i * LANES, a[i])
        store(to, (3 * i + 1) * LANES, b[i])
        store(to, (3 * i + 2) * LANES, c[i])
        store(to, (9 + i) * LANES, at[i])


@compiled
def _hand_frame(x, mirror):
    """The hand's own frame: the columns of its rotation, and its origin."""
    a, b, c = load(x, 3 * LANES), load(x, 4 * LANES), load(x, 5 * LANES)
    square = a * a + b * b + c * c
    half = _HALF * root(square)
    sine, cosine = _sin_cos(half)
    sinc = where_above(half - np.float32(1e-6), sine / half, splat(_ONE))
    p, q = sinc * cosine, _HALF * sinc * sinc
    one = _ONE - q * square
    return (
        ((one + q * a * a) * mirror, (q * a * b + p * c) * mirror, (q * a * c - p * b) * mirror),
        (q * a * b - p * c, one + q * b * b, q * b * c + p * a),
        (q * a * c + p * b, q * b * c - p * a, one + q * c * c),
        (load(x, 0), load(x, LANES), load(x, 2 * LANES)),
    )


@compiled
def _sum(frame, w):
    """The columns of a frame's rotation, weighted."""
    a, b, c, _ = frame
    return (
        a[0] * w[0] + b[0] * w[1] + c[0] * w[2],
        a[1] * w[0] + b[1] * w[1] + c[1] * w[2],
        a[2] * w[0] + b[2] * w[1] + c[2] * w[2],
    )


@compiled
def _moved(point, by):
    return point[0] + by[0], point[1] + by[1], point[2] + by[2]


@compiled
def _followed(frame, length):
    """The frame at the end of a bone, turned as the bone."""
    a, b, c, at = frame
    at = at[0] - length * b[0], at[1] - length * b[1], at[2] - length * b[2]
    return a, b, c, at


@compiled
def _turned(a, b, c, at, x, abduction, flexion):
    """A frame turned about its z axis, then its x axis, by angles in these slots of the state."""
    a, b = _mixed(a, b, x, abduction)
    b, c = _mixed(b, c, x, flexion)
    return a, b, c, at


@compiled
def _mixed(p, q, x, slot):
    """Two columns turned by an angle of the state, or not where there is none."""
    if slot < 0:
        return p, q
    sine, cosine = _sin_cos(load(x, slot * LANES))
    return (
        (cosine * p[0] + sine * q[0], cosine * p[1] + sine * q[1], cosine * p[2] + sine * q[2]),
        (cosine * q[0] - sine * p[0], cosine * q[1] - sine * p[1], cosine * q[2] - sine * p[2]),
    )


@compiled
def _three(frame, j):
    """A row of a frame's rotation from 0, 3 or 6 on, its origin from 9 on."""
    return load(frame, j * LANES), load(frame, (j + 1) * LANES), load(frame, (j + 2) * LANES)


@compiled
def _times(s, v):
    """A symmetric matrix (xx, xy, xz, yy, yz, zz) times a vector."""
    return (
        v[0] * s[0] + v[1] * s[1] + v[2] * s[2],
        v[0] * s[1] + v[1] * s[3] + v[2] * s[4],
        v[0] * s[2] + v[1] * s[4] + v[2] * s[5],
    )


@compiled
def _dot(p, q):
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@compiled
def project_hands(frames, frame_index, surface, k, width, height, out, boxes):
    """Coefficients of the ellipsoids of LANES hands, see the module's text.

    k: fx, fy, cx, cy.
    surface: (E + 1, 9) centre and S (xx, xy, xz, yy, yz, zz) in the ellipsoid's frame.
    out: (E + 1, TERMS * LANES), in pixels and 1/m; half height -1 where there is nothing to draw.
    boxes: (4 * LANES,), first and one-past-last column and row in the image of all ellipsoids but
    the last, the wrist's.
    """
    fx, fy, px, py, width, height = k[0], k[1], k[2], k[3], np.float32(width), np.float32(height)
    left, top = splat(width), splat(height)
    right, bottom = splat(_ZERO), splat(_ZERO)
    for e in range(frame_index.shape[0]):
        frame, row = frames[frame_index[e]], out[e]
        b = surface[e, 0], surface[e, 1], surface[e, 2]
        s = surface[e, 3], surface[e, 4], surface[e, 5], surface[e, 6], surface[e, 7], surface[e, 8]
        x, y, z, at = _three(frame, 0), _three(frame, 3), _three(frame, 6), _three(frame, 9)
        cx, cy, cz = _dot(x, b) + at[0], _dot(y, b) + at[1], _dot(z, b) + at[2]
        sx, sy, sz = _times(s, x), _times(s, y), _times(s, z)
        xx, xy, xz = _dot(sx, x), _dot(sx, y), _dot(sx, z)
        yy, yz, zz = _dot(sy, y), _dot(sy, z), _dot(sz, z)
        z2 = cz * cz
        iw = _ONE / (z2 - zz)
        iw2 = iw * iw
        kxx = (xx * z2 - _TWO * xz * cx * cz + zz * cx * cx - xx * zz + xz * xz) * iw2
        kyy = (yy * z2 - _TWO * yz * cy * cz + zz * cy * cy - yy * zz + yz * yz) * iw2
        kxy = (xy * z2 - (yz * cx + xz * cy) * cz + zz * cx * cy - xy * zz + xz * yz) * iw2
        kxu = (zz * cx - xz * cz) * iw2 * fx
        kyu = (zz * cy - yz * cz) * iw2 * fy
        kuu = zz * iw2
        kxx, kyy, kxy = kxx * fx * fx, kyy * fy * fy, kxy * fx * fy
        iy = _ONE / kyy
        lxy, luy = kxy * iy, kyu * iy
        dx = kxx - kxy * lxy
        lux = (kxu - kxy * luy) / dx
        x, y = (cx * cz - xz) * iw * fx + px, (cy * cz - yz) * iw * fy + py
        wide, high, nothing = root(kxx), root(kyy), splat(-_ONE)
        high = where_above(cz - root(zz) - _NEAREST, where_above(dx, high, nothing), nothing)
        store(row, X * LANES, x)
        store(row, Y * LANES, y)
        store(row, U * LANES, cz * iw)
        store(row, HY * LANES, high)
        store(row, IY * LANES, iy)
        store(row, XY * LANES, lxy)
        store(row, DX * LANES, dx)
        store(row, UY * LANES, luy)
        store(row, UX * LANES, lux)
        store(row, DU * LANES, kuu - kyu * luy - lux * lux * dx)
        if e < frame_index.shape[0] - 1:
            left = where_above(high, smaller(up(x - wide), left), left)
            right = where_above(high, larger(down(x + wide) + _ONE, right), right)
            top = where_above(high, smaller(up(y - high), top), top)
            bottom = where_above(high, larger(down(y + high) + _ONE, bottom), bottom)
    store(boxes, LEFT * LANES, larger(left, splat(_ZERO)))
    store(boxes, TOP * LANES, larger(top, splat(_ZERO)))
    store(boxes, RIGHT * LANES, smaller(right, splat(width)))
    store(boxes, BOTTOM * LANES, smaller(bottom, splat(height)))
