"""The kernels of the CUDA back end; see scorer.py. Formulas are those of numba/hand.py."""

from __future__ import annotations

import triton
import triton.language as tl

TERMS = 12
"""Numbers an ellipsoid on the screen: x, y, u, high, wide, 1 / D_y, shear, D_x, slopes, D_u."""


@triton.jit
def _three(p):
    return tl.load(p), tl.load(p + 1), tl.load(p + 2)


@triton.jit
def _state(row, j, keep):
    return tl.load(row + j, mask=keep, other=0.0)


@triton.jit
def _dot(a, b, c, x, y, z):
    return a * x + b * y + c * z


@triton.jit
def _map(m00, m01, m02, m10, m11, m12, m20, m21, m22, x, y, z):
    """A matrix times a vector."""
    return _dot(m00, m01, m02, x, y, z), _dot(m10, m11, m12, x, y, z), _dot(m20, m21, m22, x, y, z)


@triton.jit
def _turn(p0, p1, p2, q0, q1, q2, row, slot, keep):
    """Two columns of a frame turned by an angle of each state, or not for slot -1."""
    angle = tl.load(row + slot, mask=keep & (slot >= 0), other=0.0)
    sine, cosine = tl.sin(angle), tl.cos(angle)
    p0, q0 = cosine * p0 + sine * q0, cosine * q0 - sine * p0
    p1, q1 = cosine * p1 + sine * q1, cosine * q1 - sine * p1
    p2, q2 = cosine * p2 + sine * q2, cosine * q2 - sine * p2
    return p0, p1, p2, q0, q1, q2


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
        check += tl.abs(_state(row, j, inside))
    valid = inside & (check < 1e9)
    tx, ty, tz = _state(row, 0, valid), _state(row, 1, valid), _state(row, 2, valid)
    a, b, c = _state(row, 3, valid), _state(row, 4, valid), _state(row, 5, valid)
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
    m00, m01, m02 = _three(table + 9)
    m10, m11, m12 = _three(table + 13)
    m20, m21, m22 = _three(table + 17)
    o0, o1, o2 = tl.load(table + 12), tl.load(table + 16), tl.load(table + 20)
    x, y, z = _map(r00, r01, r02, r10, r11, r12, r20, r21, r22, o0, o1, o2)
    x, y, z = x + tx, y + ty, z + tz
    a0, a1, a2 = _map(r00, r01, r02, r10, r11, r12, r20, r21, r22, m00, m10, m20)
    b0, b1, b2 = _map(r00, r01, r02, r10, r11, r12, r20, r21, r22, m01, m11, m21)
    c0, c1, c2 = _map(r00, r01, r02, r10, r11, r12, r20, r21, r22, m02, m12, m22)
    for joint in tl.static_range(3):
        if joint > 0:
            length = tl.load(table + 20 + joint)
            x -= length * b0
            y -= length * b1
            z -= length * b2
        if joint < 2:
            slot = tl.load(slots + e * 5 + 2 * joint)
            a0, a1, a2, b0, b1, b2 = _turn(a0, a1, a2, b0, b1, b2, row, slot, valid)
        slot = tl.load(slots + e * 5 + (2 * joint + 1 if joint < 2 else 4))
        b0, b1, b2, c0, c1, c2 = _turn(b0, b1, b2, c0, c1, c2, row, slot, valid)

    d0, d1, d2 = _three(table)
    sxx, sxy, sxz = _three(table + 3)
    syy, syz, szz = _three(table + 6)
    cx, cy, cz = _map(a0, b0, c0, a1, b1, c1, a2, b2, c2, d0, d1, d2)
    cx, cy, cz = cx + x, cy + y, cz + z
    h0, h1, h2 = _map(sxx, sxy, sxz, sxy, syy, syz, sxz, syz, szz, a0, b0, c0)
    xx, xy = _dot(h0, h1, h2, a0, b0, c0), _dot(h0, h1, h2, a1, b1, c1)
    xz = _dot(h0, h1, h2, a2, b2, c2)
    h0, h1, h2 = _map(sxx, sxy, sxz, sxy, syy, syz, sxz, syz, szz, a1, b1, c1)
    yy, yz = _dot(h0, h1, h2, a1, b1, c1), _dot(h0, h1, h2, a2, b2, c2)
    h0, h1, h2 = _map(sxx, sxy, sxz, sxy, syy, syz, sxz, syz, szz, a2, b2, c2)
    zz = _dot(h0, h1, h2, a2, b2, c2)

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
                x0, y0, u0 = _three(at)
                tall0, wide0 = tl.load(at + 3), tl.load(at + 4)
                meets = (tall0 > 0) & (y0 - tall0 < tile_top + ROWS) & (y0 + tall0 >= tile_top)
                meets = meets & (x0 - wide0 < tile_left + 64) & (x0 + wide0 >= tile_left)
                if meets:
                    iy, shear, dx = _three(at + 5)
                    slope_y, slope_x, du = _three(at + 8)
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
    iy, shear, dx = _three(wrist + 5)
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
                    for way in tl.static_range(-1, 2, 2):
                        there = v + way * offset
                        a |= _row(mine, there, word - 1, top, bottom, first, last, words)
                        b |= _row(mine, there, word, top, bottom, first, last, words)
                        c |= _row(mine, there, word + 1, top, bottom, first, last, words)
                s += 1
            b &= wanted
            b = b - ((b >> 1) & 0x5555555555555555)
            b = (b & 0x3333333333333333) + ((b >> 2) & 0x3333333333333333)
            b = (b + (b >> 4)) & 0x0F0F0F0F0F0F0F0F
            total += ((b * 0x0101010101010101) >> 56) & 0xFF
            word += 1
        tile_top += ROWS
    tl.store(out + 2 * n + i, tl.sum(total).to(tl.float32))
