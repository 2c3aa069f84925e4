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

This is the form of closed_form.py in other coordinates."""

from __future__ import annotations

import math

import numpy as np

from toftrack.compute.compiling import compiled
from toftrack.render.closed_form import _NEAREST_M
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

LANES = BLOCK
"""Particles whose kinematics are computed side by side, one to a SIMD lane; a task of a thread."""
_NEAREST = np.float32(_NEAREST_M)
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
        slot, to, bone = 5 * finger, 1 + 3 * finger, lengths[finger]
        frame = _flexed(_abducted(_root(hand, base[finger]), x, slots[slot]), x, slots[slot + 1])
        _keep(frames[to], frame)
        frame = _abducted(_followed(frame, bone[0]), x, slots[slot + 2])
        frame = _flexed(frame, x, slots[slot + 3])
        _keep(frames[to + 1], frame)
        _keep(frames[to + 2], _flexed(_followed(frame, bone[1]), x, slots[slot + 4]))


@compiled
def _keep(to, frame):
    for j in range(12):
        store(to, j * LANES, frame[j])


@compiled
def _hand_frame(x, mirror):
    """The hand's own frame: nine numbers of the rotation by rows, and the origin."""
    a, b, c = load(x, 3 * LANES), load(x, 4 * LANES), load(x, 5 * LANES)
    square = a * a + b * b + c * c
    half = _HALF * root(square)
    sine, cosine = _sin_cos(half)
    sinc = where_above(half - np.float32(1e-6), sine / half, splat(_ONE))
    p, q = sinc * cosine, _HALF * sinc * sinc
    one = _ONE - q * square
    return (
        (one + q * a * a) * mirror,
        q * a * b - p * c,
        q * a * c + p * b,
        (q * a * b + p * c) * mirror,
        one + q * b * b,
        q * b * c - p * a,
        (q * a * c - p * b) * mirror,
        q * b * c + p * a,
        one + q * c * c,
        load(x, 0),
        load(x, LANES),
        load(x, 2 * LANES),
    )


@compiled
def _root(hand, base):
    """The rest frame of a finger's first bone; base: (3, 4) rotation and origin in the hand."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, x, y, z = hand
    a, b, c = base[0], base[1], base[2]
    return (
        r00 * a[0] + r01 * b[0] + r02 * c[0],
        r00 * a[1] + r01 * b[1] + r02 * c[1],
        r00 * a[2] + r01 * b[2] + r02 * c[2],
        r10 * a[0] + r11 * b[0] + r12 * c[0],
        r10 * a[1] + r11 * b[1] + r12 * c[1],
        r10 * a[2] + r11 * b[2] + r12 * c[2],
        r20 * a[0] + r21 * b[0] + r22 * c[0],
        r20 * a[1] + r21 * b[1] + r22 * c[1],
        r20 * a[2] + r21 * b[2] + r22 * c[2],
        r00 * a[3] + r01 * b[3] + r02 * c[3] + x,
        r10 * a[3] + r11 * b[3] + r12 * c[3] + y,
        r20 * a[3] + r21 * b[3] + r22 * c[3] + z,
    )


@compiled
def _followed(frame, length):
    """The frame at the end of a bone, turned as the bone."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, x, y, z = frame
    x, y, z = x - length * r01, y - length * r11, z - length * r21
    return r00, r01, r02, r10, r11, r12, r20, r21, r22, x, y, z


@compiled
def _abducted(frame, x, slot):
    """Turned about its z axis by an angle of the state, or not where there is none."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, ox, oy, oz = frame
    if slot >= 0:
        sine, cosine = _sin_cos(load(x, slot * LANES))
        r00, r01 = cosine * r00 + sine * r01, cosine * r01 - sine * r00
        r10, r11 = cosine * r10 + sine * r11, cosine * r11 - sine * r10
        r20, r21 = cosine * r20 + sine * r21, cosine * r21 - sine * r20
    return r00, r01, r02, r10, r11, r12, r20, r21, r22, ox, oy, oz


@compiled
def _flexed(frame, x, slot):
    """Turned about its x axis by an angle of the state, or not where there is none."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, ox, oy, oz = frame
    if slot >= 0:
        sine, cosine = _sin_cos(load(x, slot * LANES))
        r01, r02 = cosine * r01 + sine * r02, cosine * r02 - sine * r01
        r11, r12 = cosine * r11 + sine * r12, cosine * r12 - sine * r11
        r21, r22 = cosine * r21 + sine * r22, cosine * r22 - sine * r21
    return r00, r01, r02, r10, r11, r12, r20, r21, r22, ox, oy, oz


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
        b0, b1, b2 = surface[e, 0], surface[e, 1], surface[e, 2]
        sxx, sxy, sxz = surface[e, 3], surface[e, 4], surface[e, 5]
        syy, syz, szz = surface[e, 6], surface[e, 7], surface[e, 8]
        r0, r1, r2 = load(frame, 0), load(frame, LANES), load(frame, 2 * LANES)
        v0, v1, v2 = load(frame, 3 * LANES), load(frame, 4 * LANES), load(frame, 5 * LANES)
        w0, w1, w2 = load(frame, 6 * LANES), load(frame, 7 * LANES), load(frame, 8 * LANES)
        cx = r0 * b0 + r1 * b1 + r2 * b2 + load(frame, 9 * LANES)
        cy = v0 * b0 + v1 * b1 + v2 * b2 + load(frame, 10 * LANES)
        cz = w0 * b0 + w1 * b1 + w2 * b2 + load(frame, 11 * LANES)
        h0 = r0 * sxx + r1 * sxy + r2 * sxz
        h1 = r0 * sxy + r1 * syy + r2 * syz
        h2 = r0 * sxz + r1 * syz + r2 * szz
        xx = h0 * r0 + h1 * r1 + h2 * r2
        xy = h0 * v0 + h1 * v1 + h2 * v2
        xz = h0 * w0 + h1 * w1 + h2 * w2
        h0 = v0 * sxx + v1 * sxy + v2 * sxz
        h1 = v0 * sxy + v1 * syy + v2 * syz
        h2 = v0 * sxz + v1 * syz + v2 * szz
        yy = h0 * v0 + h1 * v1 + h2 * v2
        yz = h0 * w0 + h1 * w1 + h2 * w2
        h0 = w0 * sxx + w1 * sxy + w2 * sxz
        h1 = w0 * sxy + w1 * syy + w2 * syz
        h2 = w0 * sxz + w1 * syz + w2 * szz
        zz = h0 * w0 + h1 * w1 + h2 * w2
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
