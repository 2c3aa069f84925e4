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

LANES = 16
"""Particles whose kinematics are computed side by side, one to a SIMD lane; a task of a thread."""
_NEAREST = np.float32(_NEAREST_M)
_NOTHING = np.float32(-1.0)
# Rows of the table of coefficients of an ellipsoid.
X, Y, U, HY, IY, XY, HX, DX, UY, UX, DU, TERMS = range(12)


@compiled
def _sin_cos(x):
    """Float32 sine and cosine (Cephes' polynomials) without branches, so that loops vectorise."""
    turns = np.floor(x * np.float32(2 / math.pi) + np.float32(0.5))
    r = x - turns * np.float32(1.5703125)
    r = r - turns * np.float32(4.837512969970703125e-4)
    r = r - turns * np.float32(7.54978995489188216e-8)
    s = r * r
    sine = np.float32(-1.9515295891e-4) * s + np.float32(8.3321608736e-3)
    sine = (sine * s - np.float32(1.6666654611e-1)) * s * r + r
    cosine = np.float32(2.443315711809948e-5) * s - np.float32(1.388731625493765e-3)
    cosine = (cosine * s + np.float32(4.166664568298827e-2)) * s * s - np.float32(0.5) * s
    cosine = cosine + np.float32(1.0)
    quarter = turns - np.float32(4.0) * np.floor(turns * np.float32(0.25))
    swap = (quarter == np.float32(1.0)) | (quarter == np.float32(3.0))
    a, b = (cosine, sine) if swap else (sine, cosine)
    a = -a if quarter >= np.float32(2.0) else a
    b = -b if (quarter == np.float32(1.0)) | (quarter == np.float32(2.0)) else b
    return a, b


@compiled
def pose_hands(states, first, slots, base, lengths, mirror, x, sines, cosines, frames, valid):
    """Frames of LANES hands from states[first:], see skeleton.forward_kinematics.

    frames: (16, 12 * LANES), rotation by rows and origin.  valid: (LANES,), 0 for states that are
    not finite or past the end, whose frames are those of the zero state.
    """
    for i in range(LANES):
        row = first + i
        valid[i] = 0
        if row < states.shape[0]:
            check = np.float32(0.0)
            for j in range(27):
                check += abs(states[row, j])
            valid[i] = check < np.float32(1e9)
        for j in range(27):
            x[j * LANES + i] = states[row, j] if valid[i] else np.float32(0.0)
    for j in range(25):
        source = slots[j]
        for i in range(LANES):
            sine, cosine = _sin_cos(x[source * LANES + i] if source >= 0 else np.float32(0.0))
            sines[j * LANES + i] = sine
            cosines[j * LANES + i] = cosine
    hand = frames[0]
    for i in range(LANES):
        a, b, c = x[3 * LANES + i], x[4 * LANES + i], x[5 * LANES + i]
        square = a * a + b * b + c * c
        half = np.float32(0.5) * math.sqrt(square)
        sine, cosine = _sin_cos(half)
        sinc = sine / half if half > np.float32(1e-6) else np.float32(1.0)
        p, q = sinc * cosine, np.float32(0.5) * sinc * sinc
        one = np.float32(1.0) - q * square
        hand[i] = (one + q * a * a) * mirror
        hand[LANES + i] = q * a * b - p * c
        hand[2 * LANES + i] = q * a * c + p * b
        hand[3 * LANES + i] = (q * a * b + p * c) * mirror
        hand[4 * LANES + i] = one + q * b * b
        hand[5 * LANES + i] = q * b * c - p * a
        hand[6 * LANES + i] = (q * a * c - p * b) * mirror
        hand[7 * LANES + i] = q * b * c + p * a
        hand[8 * LANES + i] = one + q * c * c
        for j in range(3):
            hand[(9 + j) * LANES + i] = x[j * LANES + i]
    for finger in range(5):
        _root(hand, base[finger], frames[1 + 3 * finger])
        for bone in range(3):
            # The angles' slots are abduction, flexion, abduction, flexion, flexion.
            slot, to = 5 * finger + 2 * bone, 1 + 3 * finger + bone
            if bone > 0:
                _follow(frames[to - 1], lengths[finger, bone - 1], frames[to])
            if bone < 2:
                _rotate(frames[to], 0, sines[slot * LANES :], cosines[slot * LANES :])
                slot += 1
            _rotate(frames[to], 1, sines[slot * LANES :], cosines[slot * LANES :])


@compiled
def _root(hand, base, frame):
    """The rest frame of a finger's first bone; base: (3, 4) rotation and origin in the hand."""
    for j in range(3):
        for k in range(4):
            b0, b1, b2 = base[0, k], base[1, k], base[2, k]
            row, to = 3 * j, 3 * j + k if k < 3 else 9 + j
            for i in range(LANES):
                value = hand[row * LANES + i] * b0 + hand[(row + 1) * LANES + i] * b1
                value += hand[(row + 2) * LANES + i] * b2
                frame[to * LANES + i] = value + (
                    hand[to * LANES + i] if k == 3 else np.float32(0.0)
                )


@compiled
def _follow(before, length, frame):
    """The frame at the end of a bone, turned as the bone."""
    for j in range(9 * LANES):
        frame[j] = before[j]
    for j in range(3):
        for i in range(LANES):
            along = length * before[(3 * j + 1) * LANES + i]
            frame[(9 + j) * LANES + i] = before[(9 + j) * LANES + i] - along


@compiled
def _rotate(frame, column, sines, cosines):
    """Turn about z (column 0) or x (column 1): mix two neighbouring columns of the rotation."""
    for j in range(3):
        line = frame[(3 * j + column) * LANES : (3 * j + column + 2) * LANES]
        for i in range(LANES):
            p, q, sine, cosine = line[i], line[LANES + i], sines[i], cosines[i]
            line[i] = cosine * p + sine * q
            line[LANES + i] = cosine * q - sine * p


@compiled
def project_hands(frames, frame_index, surface, fx, fy, px, py, out):
    """Coefficients of the ellipsoids of LANES hands, see the module's text.

    surface: (E + 1, 9) centre and S (xx, xy, xz, yy, yz, zz) in the ellipsoid's frame.
    out: (E + 1, TERMS * LANES), in pixels and 1/m; half height -1 where there is nothing to draw.
    """
    for e in range(frame_index.shape[0]):
        frame, row = frames[frame_index[e]], out[e]
        b0, b1, b2 = surface[e, 0], surface[e, 1], surface[e, 2]
        sxx, sxy, sxz = surface[e, 3], surface[e, 4], surface[e, 5]
        syy, syz, szz = surface[e, 6], surface[e, 7], surface[e, 8]
        for i in range(LANES):
            r0, r1, r2 = frame[i], frame[LANES + i], frame[2 * LANES + i]
            cx = r0 * b0 + r1 * b1 + r2 * b2 + frame[9 * LANES + i]
            h0 = r0 * sxx + r1 * sxy + r2 * sxz
            h1 = r0 * sxy + r1 * syy + r2 * syz
            h2 = r0 * sxz + r1 * syz + r2 * szz
            xx = h0 * r0 + h1 * r1 + h2 * r2
            v0, v1, v2 = frame[3 * LANES + i], frame[4 * LANES + i], frame[5 * LANES + i]
            cy = v0 * b0 + v1 * b1 + v2 * b2 + frame[10 * LANES + i]
            xy = h0 * v0 + h1 * v1 + h2 * v2
            w0, w1, w2 = frame[6 * LANES + i], frame[7 * LANES + i], frame[8 * LANES + i]
            cz = w0 * b0 + w1 * b1 + w2 * b2 + frame[11 * LANES + i]
            xz = h0 * w0 + h1 * w1 + h2 * w2
            h0 = v0 * sxx + v1 * sxy + v2 * sxz
            h1 = v0 * sxy + v1 * syy + v2 * syz
            h2 = v0 * sxz + v1 * syz + v2 * szz
            yy = h0 * v0 + h1 * v1 + h2 * v2
            yz = h0 * w0 + h1 * w1 + h2 * w2
            zz = (
                (w0 * sxx + w1 * sxy + w2 * sxz) * w0
                + (w0 * sxy + w1 * syy + w2 * syz) * w1
                + (w0 * sxz + w1 * syz + w2 * szz) * w2
            )
            visible = cz - math.sqrt(zz) > _NEAREST
            iw = np.float32(1.0) / (cz * cz - zz)
            iw2 = iw * iw
            z2 = cz * cz
            kxx = (
                xx * z2 - np.float32(2.0) * xz * cx * cz + zz * cx * cx - xx * zz + xz * xz
            ) * iw2
            kyy = (
                yy * z2 - np.float32(2.0) * yz * cy * cz + zz * cy * cy - yy * zz + yz * yz
            ) * iw2
            kxy = (xy * z2 - (yz * cx + xz * cy) * cz + zz * cx * cy - xy * zz + xz * yz) * iw2
            kxu = (zz * cx - xz * cz) * iw2 * fx
            kyu = (zz * cy - yz * cz) * iw2 * fy
            kuu = zz * iw2
            kxx, kyy, kxy = kxx * fx * fx, kyy * fy * fy, kxy * fx * fy
            iy = np.float32(1.0) / kyy
            lxy, luy = kxy * iy, kyu * iy
            dx = kxx - kxy * lxy
            lux = (kxu - kxy * luy) / dx
            row[X * LANES + i] = (cx * cz - xz) * iw * fx + px
            row[Y * LANES + i] = (cy * cz - yz) * iw * fy + py
            row[U * LANES + i] = cz * iw
            row[HY * LANES + i] = math.sqrt(kyy) if visible else _NOTHING
            row[IY * LANES + i] = iy
            row[XY * LANES + i] = lxy
            row[HX * LANES + i] = math.sqrt(kxx)
            row[DX * LANES + i] = dx
            row[UY * LANES + i] = luy
            row[UX * LANES + i] = lux
            row[DU * LANES + i] = kuu - kyu * luy - lux * lux * dx
