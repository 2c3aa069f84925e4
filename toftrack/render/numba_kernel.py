"""The fused CPU kernel: from a state of 27 numbers to four counts, one particle at a time.

A projective map takes ellipsoids to ellipsoids, so in (column, row, inverse depth) an ellipsoid
{c + F u : |u| <= 1} with S = F F' is again one, and w = c_z^2 - S_zz gives its centre and "covariance"

    x0 = (c_x c_z - S_xz) / w,   u0 = c_z / w,          (y as x)
    K_xx = (S_xx c_z^2 - 2 S_xz c_x c_z + S_zz c_x^2 - S_xx S_zz + S_xz^2) / w^2,
    K_xu = (S_zz c_x - S_xz c_z) / w^2,   K_uu = S_zz / w^2,

without an inverse and without cancellation. Eliminating row, column and inverse depth in this
order (K = L D L') yields the rows, the exact span of columns in a row, and the near surface

    u = u0 + L_uy dy + L_ux t + sqrt(D_u (1 - dy^2 / D_y - t^2 / D_x)),   t = dx - L_xy dy.

This is the form of closed_form.py in other coordinates. Only silhouette pixels that lie on the
outline to within float32 differ. Everything is in one module, because numba's cache notices changes
of the cached function's own file only.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

LANES = 8
"""Particles whose kinematics are computed side by side, one to a SIMD lane; a task of a thread."""
BLOCK = 16
"""Pixels of a row that are worked on at once; images need this much padding on the right."""
_NEAREST = np.float32(0.02)  # closed_form._NEAREST_M
_NOTHING = np.float32(-1.0)
# Rows of the table of coefficients of an ellipsoid.
_X, _Y, _U, _HY, _IY, _XY, _HX, _DX, _UY, _UX, _DU, _TERMS = range(12)

# nnan and ninf stay off: a missed pixel is the NaN of a negative square root, states may be NaN.
_FLAGS = {"contract", "arcp", "nsz"}
_jit = nb.njit(fastmath=_FLAGS, nogil=True)
_inline = nb.njit(fastmath=_FLAGS, nogil=True, inline="never")


# ---- vector instructions that plain Python does not reach -----------------------------------------

_VECTOR = ir.VectorType(ir.FloatType(), BLOCK)


def _pointer(context, builder, array_type, array, index, lltype=None):
    data = context.make_array(array_type)(context, builder, array).data
    at = builder.gep(data, [index])
    return at if lltype is None else builder.bitcast(at, lltype.as_pointer())


def _load(context, builder, array_type, array, index):
    return builder.load(_pointer(context, builder, array_type, array, index, _VECTOR), align=4)


def _splat(builder, value):
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.IntType(32)(0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), BLOCK), [0] * BLOCK)
    return builder.shuffle_vector(one, ir.Constant(_VECTOR, ir.Undefined), zeros)


@intrinsic
def _draw(typingctx, tile, index, t, u, slope, peak, curve):
    """tile[index + j] = max(itself, u + slope t_j + sqrt(peak - curve t_j^2)), t_j = t + j."""

    def codegen(context, builder, signature, args):
        tile, index, *numbers = args
        t, u, slope, peak, curve = (_splat(builder, number) for number in numbers)
        fast = ("contract",)
        steps = ir.Constant(_VECTOR, [float(j) for j in range(BLOCK)])
        t = builder.fadd(t, steps)
        below = builder.fsub(peak, builder.fmul(curve, builder.fmul(t, t), fast), flags=fast)
        sqrt = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_VECTOR, [_VECTOR]), f"llvm.sqrt.v{BLOCK}f32"
        )
        plane = builder.fadd(u, builder.fmul(slope, t, flags=fast), flags=fast)
        new = builder.fadd(plane, builder.call(sqrt, [below]))
        at = _pointer(context, builder, signature.args[0], tile, index, _VECTOR)
        old = builder.load(at, align=4)
        # An ordered comparison: the NaN of a missed pixel loses.
        builder.store(builder.select(builder.fcmp_ordered(">", new, old), new, old), at, align=4)
        return context.get_dummy_value()

    return types.void(tile, types.intp, *(types.float32,) * 5), codegen


@intrinsic
def _count(typingctx, tile, index, images, low, high, occluder, residuals):
    """Bits of model, correct and false in the three lowest 16 bits; adds to `residuals`."""

    def codegen(context, builder, signature, args):
        kinds = signature.args
        u = _load(context, builder, kinds[0], args[0], args[1])
        low, high, occluder = (_load(context, builder, kinds[2], args[2], i) for i in args[3:6])
        zero, half = (ir.Constant(_VECTOR, [value] * BLOCK) for value in (0.0, 0.5))
        model = builder.fcmp_ordered(">", u, zero)
        correct = builder.and_(
            builder.fcmp_ordered(">=", u, low), builder.fcmp_ordered("<=", u, high)
        )
        correct = builder.and_(model, correct)
        false = builder.and_(model, builder.fcmp_ordered(">=", u, occluder))
        false = builder.and_(false, builder.not_(correct))
        middle = builder.fmul(builder.fadd(low, high), half)
        width = builder.fmul(builder.fsub(high, low), half)
        part = builder.fdiv(builder.fsub(u, middle), width)
        part = builder.select(correct, builder.fmul(part, part), zero)
        at = _pointer(context, builder, kinds[6], args[6], ir.IntType(64)(0), _VECTOR)
        builder.store(builder.fadd(builder.load(at, align=4), part), at, align=4)
        word, packed = ir.IntType(64), ir.IntType(64)(0)
        for shift, bits in ((0, model), (BLOCK, correct), (2 * BLOCK, false)):
            bits = builder.zext(builder.bitcast(bits, ir.IntType(BLOCK)), word)
            packed = builder.or_(packed, builder.shl(bits, word(shift)))
        return packed

    indices = (types.intp,) * 3
    return types.uint64(tile, types.intp, images, *indices, residuals), codegen


@intrinsic
def _ones(typingctx, word):
    """How many bits are set."""

    def codegen(context, builder, signature, args):
        return builder.ctpop(args[0])

    return types.int64(types.uint64), codegen


@intrinsic
def _take(typingctx, counter):
    """counter[0] += 1, atomically; the value before."""

    def codegen(context, builder, signature, args):
        at = _pointer(context, builder, signature.args[0], args[0], ir.IntType(64)(0))
        return builder.atomic_rmw("add", at, ir.IntType(64)(1), "monotonic")

    return types.int64(counter), codegen


# ---- kinematics -----------------------------------------------------------------------------------


@_jit
def _sin_cos(x):
    """Branch-free float32 sine and cosine (Cephes' polynomials), so that loops over it vectorise."""
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


@_jit
def _pose(states, first, slots, base, lengths, mirror, x, trig, frames, valid):
    """Frames of LANES hands from states[first:], see skeleton.forward_kinematics.

    frames: (16, 12, LANES), rotation by rows and origin.  valid: (LANES,), 0 for states that are not
    finite or past the end, whose frames are those of the zero state.
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
            x[j, i] = states[row, j] if valid[i] else np.float32(0.0)
    for j in range(25):
        source = slots[j]
        for i in range(LANES):
            sine, cosine = _sin_cos(x[source, i] if source >= 0 else np.float32(0.0))
            trig[0, j, i] = sine
            trig[1, j, i] = cosine
    for i in range(LANES):
        a, b, c = x[3, i], x[4, i], x[5, i]
        square = a * a + b * b + c * c
        half = np.float32(0.5) * math.sqrt(square)
        sine, cosine = _sin_cos(half)
        sinc = sine / half if half > np.float32(1e-6) else np.float32(1.0)
        p, q = sinc * cosine, np.float32(0.5) * sinc * sinc
        one = np.float32(1.0) - q * square
        frames[0, 0, i] = (one + q * a * a) * mirror
        frames[0, 1, i] = q * a * b - p * c
        frames[0, 2, i] = q * a * c + p * b
        frames[0, 3, i] = (q * a * b + p * c) * mirror
        frames[0, 4, i] = one + q * b * b
        frames[0, 5, i] = q * b * c - p * a
        frames[0, 6, i] = (q * a * c - p * b) * mirror
        frames[0, 7, i] = q * b * c + p * a
        frames[0, 8, i] = one + q * c * c
        for j in range(3):
            frames[0, 9 + j, i] = x[j, i]
    for finger in range(5):
        for bone in range(3):
            _turn(frames, finger, bone, base, lengths, trig)


@_jit
def _turn(frames, finger, bone, base, lengths, trig):
    """One bone of LANES hands: R exp([z] abduction) exp([x] flexion), from the frame before it."""
    to = 1 + 3 * finger + bone
    slot = 5 * finger + 2 * bone
    # The last joint has no abduction: its slots are abduction, flexion, abduction, flexion, flexion.
    flexion = slot + 1 if bone < 2 else slot
    for j in range(3):
        for i in range(LANES):
            if bone == 0:
                # The finger's base in the palm: (3, 4) of rest rotation and position.
                m, n, o = frames[0, 3 * j, i], frames[0, 3 * j + 1, i], frames[0, 3 * j + 2, i]
                p = m * base[finger, 0, 0] + n * base[finger, 1, 0] + o * base[finger, 2, 0]
                q = m * base[finger, 0, 1] + n * base[finger, 1, 1] + o * base[finger, 2, 1]
                r = m * base[finger, 0, 2] + n * base[finger, 1, 2] + o * base[finger, 2, 2]
                origin = m * base[finger, 0, 3] + n * base[finger, 1, 3] + o * base[finger, 2, 3]
                origin += frames[0, 9 + j, i]
            else:
                p, q = frames[to - 1, 3 * j, i], frames[to - 1, 3 * j + 1, i]
                r = frames[to - 1, 3 * j + 2, i]
                origin = frames[to - 1, 9 + j, i] - lengths[finger, bone - 1] * q
            if bone < 2:
                sine, cosine = trig[0, slot, i], trig[1, slot, i]
                p, q = cosine * p + sine * q, cosine * q - sine * p
            sine, cosine = trig[0, flexion, i], trig[1, flexion, i]
            frames[to, 3 * j, i] = p
            frames[to, 3 * j + 1, i] = cosine * q + sine * r
            frames[to, 3 * j + 2, i] = cosine * r - sine * q
            frames[to, 9 + j, i] = origin


@_jit
def _conics(frames, frame_index, surface, fx, fy, px, py, out):
    """Coefficients of the ellipsoids of LANES hands, see the module's text.

    surface: (E + 1, 9) centre and S (xx, xy, xz, yy, yz, zz) in the ellipsoid's frame.
    out: (E + 1, _TERMS, LANES), in pixels and 1/m; half height -1 where there is nothing to draw.
    """
    for e in range(frame_index.shape[0]):
        f = frame_index[e]
        b0, b1, b2 = surface[e, 0], surface[e, 1], surface[e, 2]
        sxx, sxy, sxz = surface[e, 3], surface[e, 4], surface[e, 5]
        syy, syz, szz = surface[e, 6], surface[e, 7], surface[e, 8]
        for i in range(LANES):
            r0, r1, r2 = frames[f, 0, i], frames[f, 1, i], frames[f, 2, i]
            cx = r0 * b0 + r1 * b1 + r2 * b2 + frames[f, 9, i]
            h0 = r0 * sxx + r1 * sxy + r2 * sxz
            h1 = r0 * sxy + r1 * syy + r2 * syz
            h2 = r0 * sxz + r1 * syz + r2 * szz
            xx = h0 * r0 + h1 * r1 + h2 * r2
            v0, v1, v2 = frames[f, 3, i], frames[f, 4, i], frames[f, 5, i]
            cy = v0 * b0 + v1 * b1 + v2 * b2 + frames[f, 10, i]
            xy = h0 * v0 + h1 * v1 + h2 * v2
            w0, w1, w2 = frames[f, 6, i], frames[f, 7, i], frames[f, 8, i]
            cz = w0 * b0 + w1 * b1 + w2 * b2 + frames[f, 11, i]
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
            out[e, _X, i] = (cx * cz - xz) * iw * fx + px
            out[e, _Y, i] = (cy * cz - yz) * iw * fy + py
            out[e, _U, i] = cz * iw
            out[e, _HY, i] = math.sqrt(kyy) if visible else _NOTHING
            out[e, _IY, i] = iy
            out[e, _XY, i] = lxy
            out[e, _HX, i] = math.sqrt(kxx)
            out[e, _DX, i] = dx
            out[e, _UY, i] = luy
            out[e, _UX, i] = lux
            out[e, _DU, i] = kuu - kyu * luy - lux * lux * dx


# ---- one particle: draw, count, and the neighbourhood of the silhouette ---------------------------


@_jit
def _run(first, last):
    """A word with bits first .. last set, as far as they lie within it."""
    first, last = max(first, 0), min(last, 63)
    if last < first:
        return np.uint64(0)
    return (~np.uint64(0) >> np.uint64(63 - (last - first))) << np.uint64(first)


@_jit
def _clip(value, size):
    """The float as an integer in 0 .. size; 0 for NaN."""
    if not value > 0:
        return 0
    return size if value >= size else int(value)


@_jit
def _box(conics, i, width, height):
    """First and one-past-last column and row of all ellipsoids but the wrist's, in the image."""
    left, top, right, bottom = width, height, 0, 0
    for e in range(conics.shape[0] - 1):
        high = conics[e, _HY, i]
        if high > 0:
            x, wide, y = conics[e, _X, i], conics[e, _HX, i], conics[e, _Y, i]
            left = min(left, _clip(math.ceil(x - wide), width))
            right = max(right, _clip(math.floor(x + wide) + 1, width))
            top = min(top, _clip(math.ceil(y - high), height))
            bottom = max(bottom, _clip(math.floor(y + high) + 1, height))
    return left, top, right, bottom


@_jit
def _span(conic, dy):
    """Middle column and half width of an ellipsoid's outline in a row, and 1 - dy^2 / D_y."""
    rest = max(np.float32(1.0) - dy * dy * conic[_IY], np.float32(0.0))
    return conic[_X] + conic[_XY] * dy, math.sqrt(conic[_DX] * rest), rest


@_jit
def _render(conics, i, conic, box, origin, stride, tile, spans):
    """The largest inverse depth of each pixel of the box, 0 = none; tile columns from `origin`.

    spans: (2, rows) first and last tile column drawn in each row.
    """
    left, top, right, bottom = box
    for row in range(bottom - top):
        spans[0, row], spans[1, row] = stride, -1
        for column in range(row * stride + left - origin, row * stride + right - origin + BLOCK):
            tile[np.uint64(column)] = np.float32(0.0)
    first_allowed, last_allowed = np.float32(left), np.float32(right - 1)
    for e in range(conics.shape[0] - 1):
        for j in range(_TERMS):
            conic[j] = conics[e, j, i]
        if not conic[_HY] > 0:
            continue
        begin = max(_clip(math.ceil(conic[_Y] - conic[_HY]), bottom), top)
        end = _clip(math.floor(conic[_Y] + conic[_HY]) + 1, bottom)
        curve = conic[_DU] / conic[_DX]
        for y in range(begin, end):
            dy = np.float32(y) - conic[_Y]
            middle, half, rest = _span(conic, dy)
            low = max(np.float32(math.ceil(middle - half)), first_allowed)
            high = min(np.float32(math.floor(middle + half)), last_allowed)
            if not low <= high:
                continue
            first, last, row = int(low) - origin, int(high) - origin, y - top
            spans[0, row] = min(spans[0, row], first)
            spans[1, row] = max(spans[1, row], last)
            u, peak = conic[_U] + conic[_UY] * dy, conic[_DU] * rest
            t, at = low - middle, row * stride + first
            for _ in range((last - first) // BLOCK + 1):
                _draw(tile, at, t, u, conic[_UX], peak, curve)
                t += np.float32(BLOCK)
                at += BLOCK


@_jit
def _dilate(model, here, there, words, reach, rows, first, last, halves):
    """Exact Euclidean disc dilation of bit rows; the result is in the returned one of the buffers.

    A disc is a horizontal run for each row offset dy. Taken from the longest run to the shortest,
    each step widens all that came before by the difference (Horner's scheme).

    model: (words + 2, reach + rows + reach), bit rows by word, with empty words and rows around.
    here, there: (words + 2, rows) buffers with empty words around.  halves: (reach + 1,) half runs.
    first, last: rows wanted.
    """
    one, top = np.uint64(1), np.uint64(63)
    for w in range(1, words + 1):
        for r in range(first, last):
            here[w, r] = model[w, reach + r]
    for dy in range(1, reach + 2):
        grow = halves[dy - 1] - halves[dy] if dy <= reach else halves[reach]
        for _ in range(grow):
            for w in range(1, words + 1):
                for r in range(first, last):
                    x = here[w, r]
                    there[w, r] = (
                        x
                        | (x << one)
                        | (x >> one)
                        | (here[w - 1, r] >> top)
                        | (here[w + 1, r] << top)
                    )
            here, there = there, here
        if dy <= reach:
            for w in range(1, words + 1):
                for r in range(first, last):
                    here[w, r] |= model[w, reach + r - dy] | model[w, reach + r + dy]
    return here
