"""The kernels of the CUDA back end; see scorer.py. Formulas are those of numba/hand.py."""

from __future__ import annotations

import triton
import triton.language as tl

TERMS = 12
"""Numbers an ellipsoid on the screen: x, y, u, high, wide, 1 / D_y, shear, D_x, slopes, D_u."""


@triton.jit
def _mix(p, q, sine, cosine):
    return cosine * p + sine * q, cosine * q - sine * p


@triton.jit
def _angle(row, slot, keep):
    """Sine and cosine of an angle of each state; 0 and 1 for slot -1."""
    angle = tl.load(row + slot, mask=keep & (slot >= 0), other=0.0)
    return tl.sin(angle), tl.cos(angle)


@triton.jit
def project_kernel(states, camera, numbers, slots, out, n, count, nearest, BLOCK: tl.constexpr):
    """One ellipsoid of BLOCK particles: states (N, 27) to out (N, E + 1, TERMS).

    numbers: (E + 1, 24) centre and S in its frame (9), rest rotation and origin of its finger by
        rows (12), lengths of the bones before it (2), mirror (1).  slots: (E + 1, 5) where the
        angles on the way to the frame are in a state, -1 = none.
    """
    e = tl.program_id(1)
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = at < n
    row = states + at.to(tl.int64) * 27
    check = tl.zeros([BLOCK], tl.float32)
    for j in range(27):
        check += tl.abs(tl.load(row + j, mask=inside, other=0.0))
    valid = inside & (check < 1e9)
    tx = tl.load(row, mask=valid, other=0.0)
    ty = tl.load(row + 1, mask=valid, other=0.0)
    tz = tl.load(row + 2, mask=valid, other=0.0)
    a = tl.load(row + 3, mask=valid, other=0.0)
    b = tl.load(row + 4, mask=valid, other=0.0)
    c = tl.load(row + 5, mask=valid, other=0.0)
    table = numbers + e * 24
    mirror = tl.load(table + 23)
    square = a * a + b * b + c * c
    half = 0.5 * tl.sqrt(square)
    sinc = tl.where(half > 1e-6, tl.sin(half) / tl.maximum(half, 1e-6), 1.0)
    p, q = sinc * tl.cos(half), 0.5 * sinc * sinc
    one = 1.0 - q * square
    r00, r01, r02 = (one + q * a * a) * mirror, q * a * b - p * c, q * a * c + p * b
    r10, r11, r12 = (q * a * b + p * c) * mirror, one + q * b * b, q * b * c - p * a
    r20, r21, r22 = (q * a * c - p * b) * mirror, q * b * c + p * a, one + q * c * c

    # The finger's rest frame in the palm, then its bones; all of it the identity for the palm.
    m00, m01, m02 = tl.load(table + 9), tl.load(table + 10), tl.load(table + 11)
    m10, m11, m12 = tl.load(table + 13), tl.load(table + 14), tl.load(table + 15)
    m20, m21, m22 = tl.load(table + 17), tl.load(table + 18), tl.load(table + 19)
    o0, o1, o2 = tl.load(table + 12), tl.load(table + 16), tl.load(table + 20)
    x = r00 * o0 + r01 * o1 + r02 * o2 + tx
    y = r10 * o0 + r11 * o1 + r12 * o2 + ty
    z = r20 * o0 + r21 * o1 + r22 * o2 + tz
    a0, b0, c0 = (
        r00 * m00 + r01 * m10 + r02 * m20,
        r00 * m01 + r01 * m11 + r02 * m21,
        r00 * m02 + r01 * m12 + r02 * m22,
    )
    a1, b1, c1 = (
        r10 * m00 + r11 * m10 + r12 * m20,
        r10 * m01 + r11 * m11 + r12 * m21,
        r10 * m02 + r11 * m12 + r12 * m22,
    )
    a2, b2, c2 = (
        r20 * m00 + r21 * m10 + r22 * m20,
        r20 * m01 + r21 * m11 + r22 * m21,
        r20 * m02 + r21 * m12 + r22 * m22,
    )
    for joint in tl.static_range(3):
        if joint > 0:
            length = tl.load(table + 20 + joint)
            x -= length * b0
            y -= length * b1
            z -= length * b2
        if joint < 2:
            sine, cosine = _angle(row, tl.load(slots + e * 5 + 2 * joint), valid)
            a0, b0 = _mix(a0, b0, sine, cosine)
            a1, b1 = _mix(a1, b1, sine, cosine)
            a2, b2 = _mix(a2, b2, sine, cosine)
        flexion = 2 * joint + 1 if joint < 2 else 4
        sine, cosine = _angle(row, tl.load(slots + e * 5 + flexion), valid)
        b0, c0 = _mix(b0, c0, sine, cosine)
        b1, c1 = _mix(b1, c1, sine, cosine)
        b2, c2 = _mix(b2, c2, sine, cosine)

    d0, d1, d2 = tl.load(table), tl.load(table + 1), tl.load(table + 2)
    sxx, sxy, sxz = tl.load(table + 3), tl.load(table + 4), tl.load(table + 5)
    syy, syz, szz = tl.load(table + 6), tl.load(table + 7), tl.load(table + 8)
    cx = a0 * d0 + b0 * d1 + c0 * d2 + x
    cy = a1 * d0 + b1 * d1 + c1 * d2 + y
    cz = a2 * d0 + b2 * d1 + c2 * d2 + z
    h0, h1, h2 = (
        a0 * sxx + b0 * sxy + c0 * sxz,
        a0 * sxy + b0 * syy + c0 * syz,
        a0 * sxz + b0 * syz + c0 * szz,
    )
    xx, xy, xz = (
        h0 * a0 + h1 * b0 + h2 * c0,
        h0 * a1 + h1 * b1 + h2 * c1,
        h0 * a2 + h1 * b2 + h2 * c2,
    )
    h0, h1, h2 = (
        a1 * sxx + b1 * sxy + c1 * sxz,
        a1 * sxy + b1 * syy + c1 * syz,
        a1 * sxz + b1 * syz + c1 * szz,
    )
    yy, yz = h0 * a1 + h1 * b1 + h2 * c1, h0 * a2 + h1 * b2 + h2 * c2
    h0, h1, h2 = (
        a2 * sxx + b2 * sxy + c2 * sxz,
        a2 * sxy + b2 * syy + c2 * syz,
        a2 * sxz + b2 * syz + c2 * szz,
    )
    zz = h0 * a2 + h1 * b2 + h2 * c2

    fx, fy, px, py = tl.load(camera), tl.load(camera + 4), tl.load(camera + 2), tl.load(camera + 5)
    visible = valid & (cz - tl.sqrt(zz) > nearest)
    z2 = cz * cz
    w = 1.0 / (z2 - zz)
    w2 = w * w
    kxx = (xx * z2 - 2.0 * xz * cx * cz + zz * cx * cx - xx * zz + xz * xz) * w2 * fx * fx
    kyy = (yy * z2 - 2.0 * yz * cy * cz + zz * cy * cy - yy * zz + yz * yz) * w2 * fy * fy
    kxy = (xy * z2 - (yz * cx + xz * cy) * cz + zz * cx * cy - xy * zz + xz * yz) * w2 * fx * fy
    kxu = (zz * cx - xz * cz) * w2 * fx
    kyu = (zz * cy - yz * cz) * w2 * fy
    iy = 1.0 / kyy
    shear, slope_y = kxy * iy, kyu * iy
    dx = kxx - kxy * shear
    slope_x = (kxu - kxy * slope_y) / dx
    to = out + (at.to(tl.int64) * count + e) * 12
    tl.store(to, (cx * cz - xz) * w * fx + px, mask=inside)
    tl.store(to + 1, (cy * cz - yz) * w * fy + py, mask=inside)
    tl.store(to + 2, cz * w, mask=inside)
    tl.store(to + 3, tl.where(visible, tl.sqrt(tl.maximum(kyy, 0.0)), -1.0), mask=inside)
    tl.store(to + 4, tl.sqrt(tl.maximum(kxx, 0.0)), mask=inside)
    tl.store(to + 5, iy, mask=inside)
    tl.store(to + 6, shear, mask=inside)
    tl.store(to + 7, dx, mask=inside)
    tl.store(to + 8, slope_y, mask=inside)
    tl.store(to + 9, slope_x, mask=inside)
    tl.store(to + 10, zz * w2 - kyu * slope_y - slope_x * slope_x * dx, mask=inside)


@triton.jit
def pack_kernel(hand, out, width, words):
    """A row of the hand's mask, (H, W) uint8, to (H, words) int64."""
    v, w = tl.program_id(0), tl.program_id(1)
    column = tl.arange(0, 64)
    u = w * 64 + column
    bits = tl.load(hand + v * width + u, mask=u < width, other=0)
    bits = (bits != 0).to(tl.int64) << column.to(tl.int64)
    tl.store(out + v * words + w, tl.sum(bits, 0))


@triton.jit
def _whole(value, size):
    """A float as an integer in 0 .. size, 0 for NaN."""
    return tl.minimum(tl.maximum(value, 0.0), size * 1.0).to(tl.int32)


@triton.jit
def count_kernel(
    conics,
    low,
    high,
    occluder,
    model,
    boxes,
    out,
    n,
    height,
    width,
    words,
    count: tl.constexpr,
    ELLIPSOIDS: tl.constexpr,
    ROWS: tl.constexpr,
):
    """Draw one particle and compare it, tile by tile of ROWS x 64 pixels within its own box.

    conics: (N, E + 1, TERMS).  low, high, occluder: (H, W).  model: (N, H, words) int64, bits of
    the silhouette, set within the box only.  boxes: (N, 4) int32, the box in whole tiles.
    out: (4, N) correct, false, missed, residual; missed is left out.
    """
    i = tl.program_id(0)
    mine = conics + i.to(tl.int64) * count * 12
    e = tl.arange(0, ELLIPSOIDS)
    hand = e < count - 1
    x = tl.load(mine + e * 12, mask=hand, other=0.0)
    y = tl.load(mine + e * 12 + 1, mask=hand, other=0.0)
    tall = tl.load(mine + e * 12 + 3, mask=hand, other=-1.0)
    wide = tl.load(mine + e * 12 + 4, mask=hand, other=0.0)
    far = 1e9
    left = _whole(tl.min(tl.where(tall > 0, x - wide, far), 0), width) // 64 * 64
    top = _whole(tl.min(tl.where(tall > 0, y - tall, far), 0), height)
    right = _whole(tl.max(tl.where(tall > 0, x + wide, -far), 0) + 1.0, width)
    bottom = _whole(tl.max(tl.where(tall > 0, y + tall, -far), 0) + 1.0, height)
    tl.store(boxes + i * 4, left)
    tl.store(boxes + i * 4 + 1, top)
    tl.store(boxes + i * 4 + 2, right)
    tl.store(boxes + i * 4 + 3, bottom)
    correct_sum, false_sum, residual_sum = 0.0, 0.0, 0.0
    column, line = tl.arange(0, 64), tl.arange(0, ROWS)
    tile_top = top
    while tile_top < bottom:
        v = tile_top + line
        tile_left = left
        while tile_left < right:
            u = tile_left + column
            depth = tl.zeros([ROWS, 64], tl.float32)
            for j in range(count - 1):
                at = mine + j * 12
                x0, y0, u0 = tl.load(at), tl.load(at + 1), tl.load(at + 2)
                tall0, wide0 = tl.load(at + 3), tl.load(at + 4)
                meets = (tall0 > 0) & (y0 - tall0 < tile_top + ROWS) & (y0 + tall0 >= tile_top)
                meets = meets & (x0 - wide0 < tile_left + 64) & (x0 + wide0 >= tile_left)
                if meets:
                    iy, shear, dx = tl.load(at + 5), tl.load(at + 6), tl.load(at + 7)
                    slope_y, slope_x = tl.load(at + 8), tl.load(at + 9)
                    du = tl.load(at + 10)
                    dy = v.to(tl.float32) - y0
                    peak = du * (1.0 - dy * dy * iy)
                    t = u.to(tl.float32)[None, :] - (x0 + shear * dy)[:, None]
                    below = peak[:, None] - t * t * (du / dx)
                    near = (u0 + slope_y * dy)[:, None] + slope_x * t
                    near += tl.sqrt(tl.maximum(below, 0.0))
                    depth = tl.where((below >= 0) & (near > depth), near, depth)
            inside = (v < height)[:, None] & (u < width)[None, :]
            model_here = inside & (depth > 0)
            pixel = v[:, None] * width + u[None, :]
            first = tl.load(low + pixel, mask=inside, other=float("inf"))
            last = tl.load(high + pixel, mask=inside, other=float("-inf"))
            hidden = tl.load(occluder + pixel, mask=inside, other=float("inf"))
            correct = model_here & (depth >= first) & (depth <= last)
            false = model_here & (depth >= hidden) & ((depth < first) | (depth > last))
            part = (depth - 0.5 * (first + last)) / (0.5 * (last - first))
            correct_sum += tl.sum(correct.to(tl.float32))
            false_sum += tl.sum(false.to(tl.float32))
            residual_sum += tl.sum(tl.where(correct, part * part, 0.0))
            bits = tl.sum(model_here.to(tl.int64) << column.to(tl.int64)[None, :], 1)
            to = model + (i.to(tl.int64) * height + v) * words + tile_left // 64
            tl.store(to, bits, mask=v < height)
            tile_left += 64
        tile_top += ROWS
    tl.store(out + i, correct_sum)
    tl.store(out + n + i, false_sum)
    tl.store(out + 3 * n + i, residual_sum)


@triton.jit
def _row(model, v, word, top, bottom, first, last, words):
    """Words of the silhouette's rows v, 0 outside of the box that was drawn."""
    there = (v >= top) & (v < bottom) & (word >= first) & (word < last)
    return tl.load(model + v * words + word, mask=there, other=0)


@triton.jit
def _wider(left, middle, right):
    """Words with their bits widened by one to both sides (the right neighbour's lie higher)."""
    drop = 0x7FFFFFFFFFFFFFFF  # a shift to the right of a negative number brings ones in
    return middle | (middle << 1) | ((middle >> 1) & drop) | ((left >> 63) & 1) | (right << 63)


@triton.jit
def _below(bits):
    """Words with the lowest bits set, 0 .. 64 of them."""
    ones = (tl.full(bits.shape, 1, tl.int64) << tl.minimum(bits, 63).to(tl.int64)) - 1
    return tl.where(bits >= 64, -1, ones)


# These change as the hand comes nearer: a kernel for each would be compiled while tracking.
@triton.jit(do_not_specialize=["step_count", "reach"])
def missed_kernel(
    conics,
    model,
    boxes,
    hand,
    steps,
    out,
    n,
    count,
    height,
    width,
    words,
    step_count,
    reach,
    ROWS: tl.constexpr,
):
    """Hand pixels within the disc around one particle's silhouette, outside of it and the wrist's.

    The dilation is that of numba/kernel.py. A lane works on one word and its two neighbours by
    itself: what is wrong at their outer edges does not get through a word of 64 columns.
    """
    i = tl.program_id(0)
    mine = model + i.to(tl.int64) * height * words
    left, top = tl.load(boxes + i * 4), tl.load(boxes + i * 4 + 1)
    right, bottom = tl.load(boxes + i * 4 + 2), tl.load(boxes + i * 4 + 3)
    first, last = left // 64, (right + 63) // 64
    wrist = conics + (i.to(tl.int64) * count + count - 1) * 12
    x, y, tall = tl.load(wrist), tl.load(wrist + 1), tl.load(wrist + 3)
    iy, shear, dx = tl.load(wrist + 5), tl.load(wrist + 6), tl.load(wrist + 7)
    total = tl.zeros([ROWS], tl.int64)
    empty = (right <= left) | (bottom <= top)
    begin = tl.maximum(top - reach, 0)
    end = tl.where(empty, begin, tl.minimum(bottom + reach, height))
    tile_top = begin
    while tile_top < end:
        v = tile_top + tl.arange(0, ROWS)
        dy = v.to(tl.float32) - y
        rest = 1.0 - dy * dy * iy
        half = tl.sqrt(tl.maximum(dx * rest, 0.0))
        middle = x + shear * dy
        covered = tl.where(rest >= 0, tall, -1.0) > 0
        from_column = tl.where(covered, _whole(tl.ceil(middle - half), width), 0)
        to_column = tl.where(covered, _whole(tl.floor(middle + half) + 1.0, width), 0)
        word = tl.maximum(first - 1, 0)
        while word < tl.minimum(last + 1, words):
            a = _row(mine, v, word - 1, top, bottom, first, last, words)
            b = _row(mine, v, word, top, bottom, first, last, words)
            c = _row(mine, v, word + 1, top, bottom, first, last, words)
            wanted = tl.load(hand + v * words + word, mask=v < height, other=0) & ~b
            low = tl.minimum(tl.maximum(from_column - word * 64, 0), 64)
            high = tl.minimum(tl.maximum(to_column - word * 64, 0), 64)
            wanted &= ~(_below(high) & ~_below(low))
            s = step_count * 0
            while s < step_count:
                grow, offset = tl.load(steps + 2 * s), tl.load(steps + 2 * s + 1)
                if grow > 0:
                    outer_left, outer_right = a, c
                    a = _wider(tl.zeros_like(a), outer_left, b)
                    c = _wider(b, outer_right, tl.zeros_like(c))
                    b = _wider(outer_left, b, outer_right)
                if offset > 0:
                    a |= _row(mine, v - offset, word - 1, top, bottom, first, last, words)
                    a |= _row(mine, v + offset, word - 1, top, bottom, first, last, words)
                    b |= _row(mine, v - offset, word, top, bottom, first, last, words)
                    b |= _row(mine, v + offset, word, top, bottom, first, last, words)
                    c |= _row(mine, v - offset, word + 1, top, bottom, first, last, words)
                    c |= _row(mine, v + offset, word + 1, top, bottom, first, last, words)
                s += 1
            b &= wanted
            b = b - ((b >> 1) & 0x5555555555555555)
            b = (b & 0x3333333333333333) + ((b >> 2) & 0x3333333333333333)
            b = (b + (b >> 4)) & 0x0F0F0F0F0F0F0F0F
            total += ((b * 0x0101010101010101) >> 56) & 0xFF
            word += 1
        tile_top += ROWS
    tl.store(out + 2 * n + i, tl.sum(total).to(tl.float32))
