"""The kernels of pictures_triton.py. Formulas are those of pictures.py, skin_numba.py,
things_numba.py and images_numba.py; arguments in capitals are their constants.
"""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def _frustum(across, y, first, second, half):
    """See things_numba."""
    flat = across - tl.minimum(across, tl.where(y < 0, first, second))
    beyond = tl.abs(y) - half
    step, rise = second - first, 2 * half
    t = ((second - across) * step + (half - y) * rise) / (step * step + rise * rise)
    t = tl.minimum(tl.maximum(t, 0.0), 1.0)
    sx, sy = across - second + step * t, y - half + rise * t
    sign = tl.where((sx < 0) & (beyond < 0), -1.0, 1.0)
    return sign * tl.sqrt(tl.minimum(flat * flat + beyond * beyond, sx * sx + sy * sy))


@triton.jit
def _part_distance(part, x, y, z, BALL: tl.constexpr, RING: tl.constexpr, BOX: tl.constexpr):
    """See things_numba."""
    x, y, z = x - tl.load(part + 1), y - tl.load(part + 2), z - tl.load(part + 3)
    a = tl.load(part + 4) * x + tl.load(part + 5) * y + tl.load(part + 6) * z
    b = tl.load(part + 7) * x + tl.load(part + 8) * y + tl.load(part + 9) * z
    c = tl.load(part + 10) * x + tl.load(part + 11) * y + tl.load(part + 12) * z
    kind = tl.load(part).to(tl.int32)
    s0, s1, s2 = tl.load(part + 13), tl.load(part + 14), tl.load(part + 15)
    edge, wall = tl.load(part + 16), tl.load(part + 17)
    if kind == BALL:
        d = tl.sqrt(a * a + b * b + c * c) - s0
    elif kind == RING:
        across = tl.sqrt(a * a + b * b) - s0
        d = tl.sqrt(across * across + c * c) - s1
    elif kind == BOX:
        qa, qb = tl.abs(a) - s0 + edge, tl.abs(b) - s1 + edge
        qc = tl.abs(c) - s2 + edge
        oa, ob, oc = tl.maximum(qa, 0.0), tl.maximum(qb, 0.0), tl.maximum(qc, 0.0)
        inner = tl.minimum(tl.maximum(qa, tl.maximum(qb, qc)), 0.0)
        d = tl.sqrt(oa * oa + ob * ob + oc * oc) + inner - edge
    else:
        across = tl.sqrt(a * a + c * c)
        d = _frustum(across, b, s0 - edge, s1 - edge, s2 - edge) - edge
        if wall > 0:
            d = tl.maximum(d, -_frustum(across, b - 2 * wall, s0 - wall, s1 - wall, s2 + wall))
    return d


@triton.jit
def _primitive_distance(p, x, y, z):
    """See skin_numba."""
    x, y, z = x - tl.load(p), y - tl.load(p + 1), z - tl.load(p + 2)
    a0, a1, a2 = tl.load(p + 3), tl.load(p + 4), tl.load(p + 5)
    b0, b1, b2 = tl.load(p + 6), tl.load(p + 7), tl.load(p + 8)
    c0, c1, c2 = tl.load(p + 9), tl.load(p + 10), tl.load(p + 11)
    a = a0 * x + a1 * y + a2 * z
    b = b0 * x + b1 * y + b2 * z
    c = c0 * x + c1 * y + c2 * z
    first, second, length = tl.load(p + 12), tl.load(p + 13), tl.load(p + 14)
    if length >= 0:
        slope, rise = tl.load(p + 15), tl.load(p + 16)
        square = a * a + c * c
        across = tl.sqrt(square)
        beyond = b - length
        along = rise * b - slope * across
        start = tl.sqrt(square + b * b) - first
        end = tl.sqrt(square + beyond * beyond) - second
        side = across * rise + b * slope - first
        d = tl.where(along < 0, start, tl.where(along > rise * length, end, side))
    else:
        norm = tl.sqrt(a * a + b * b + c * c)
        gx = a0 * a + b0 * b + c0 * c
        gy = a1 * a + b1 * b + c1 * c
        gz = a2 * a + b2 * b + c2 * c
        d = norm * (norm - 1.0) / (tl.sqrt(gx * gx + gy * gy + gz * gz) + 1e-9)
    return d


@triton.jit
def draw_kernel(
    ellipsoids,
    boxes,
    which,
    planes,
    primitives,
    balls,
    whose,
    widths,
    parts,
    part_boxes,
    lenses,
    depth,
    labels,
    n_ellipsoids,
    n_planes,
    n_skins,
    n_primitives,
    n_parts,
    height_all,
    width_all,
    FARTHEST: tl.constexpr,
    THING: tl.constexpr,
    PART: tl.constexpr,
    BALL: tl.constexpr,
    RING: tl.constexpr,
    BOX: tl.constexpr,
    TILE: tl.constexpr,
):
    """Depths and labels of one tile of one picture; what lies outside of it is not written."""
    n = tl.program_id(1).to(tl.int64)
    tile = tl.program_id(0)
    columns = tl.cdiv(width_all, TILE)
    v0, u0 = tile // columns * TILE, tile % columns * TILE
    lane = tl.arange(0, TILE * TILE)
    v, u = v0 + lane // TILE, u0 + lane % TILE
    f, cx, cy = tl.load(lenses + n * 5), tl.load(lenses + n * 5 + 1), tl.load(lenses + n * 5 + 2)
    width = tl.load(lenses + n * 5 + 3).to(tl.int32)
    height = tl.load(lenses + n * 5 + 4).to(tl.int32)
    if (v0 < height) & (u0 < width):
        x, y = (u - cx) / f, (v - cy) / f
        square = x * x + y * y + 1.0
        norm = tl.sqrt(square)
        z = tl.full([TILE * TILE], FARTHEST, tl.float32)
        label = tl.zeros([TILE * TILE], tl.int32)
        for p in range(n_planes):
            plane = planes + (n * n_planes + p) * 4
            across = tl.load(plane) * x + tl.load(plane + 1) * y + tl.load(plane + 2)
            there = tl.load(plane + 3) / across
            z = tl.where((there > 0.1) & (there < z), there, z)
        for e in range(n_ellipsoids):
            box = boxes + (n * n_ellipsoids + e) * 4
            wide = (tl.load(box) < u0 + TILE) & (tl.load(box + 1) >= u0)
            high = (tl.load(box + 2) < v0 + TILE) & (tl.load(box + 3) >= v0)
            if wide & high:
                w = ellipsoids + (n * n_ellipsoids + e) * 13
                q0 = tl.load(w) * x + tl.load(w + 1) * y + tl.load(w + 2)
                q1 = tl.load(w + 3) * x + tl.load(w + 4) * y + tl.load(w + 5)
                q2 = tl.load(w + 6) * x + tl.load(w + 7) * y + tl.load(w + 8)
                p0, p1, p2 = tl.load(w + 9), tl.load(w + 10), tl.load(w + 11)
                a = q0 * q0 + q1 * q1 + q2 * q2
                b = q0 * p0 + q1 * p1 + q2 * p2
                disc = b * b - a * tl.load(w + 12)
                there = (b - tl.sqrt(tl.maximum(disc, 0.0))) / a
                met = (disc > 0) & (there < z)
                z = tl.where(met, there, z)
                label = tl.where(met, tl.load(which + n * n_ellipsoids + e).to(tl.int32), label)
        for q in range(n_parts):
            box = part_boxes + (n * n_parts + q) * 4
            wide = (tl.load(box) < u0 + TILE) & (tl.load(box + 1) >= u0)
            high = (tl.load(box + 2) < v0 + TILE) & (tl.load(box + 3) >= v0)
            if wide & high:
                part = parts + (n * n_parts + q) * PART
                x0, y0, z0 = tl.load(part + 1), tl.load(part + 2), tl.load(part + 3)
                r = tl.load(part + 18)
                b = x * x0 + y * y0 + z0
                disc = b * b - square * (x0 * x0 + y0 * y0 + z0 * z0 - r * r)
                root = tl.sqrt(tl.maximum(disc, 0.0))
                at, last = (b - root) / square, (b + root) / square
                going = (disc > 0) & (at < z)
                steps = 0
                left = tl.max(going.to(tl.int32))
                while (steps < 64) & (left > 0):
                    d = _part_distance(part, at * x, at * y, at, BALL, RING, BOX)
                    met = going & (d < 0.0004)
                    z = tl.where(met, at, z)
                    label = tl.where(met, THING, label)
                    at = tl.where(going, at + tl.maximum(d, 0.0002) / norm, at)
                    going = going & (d >= 0.0004) & (at <= last) & (at < z)
                    left = tl.max(going.to(tl.int32))
                    steps += 1
        for s in range(n_skins):
            hand = n * n_skins + s
            blend, outside = tl.load(widths + hand * 2), tl.load(widths + hand * 2 + 1)
            wide = 2.77 * blend
            first = tl.full([TILE * TILE], 9.0, tl.float32)
            last = tl.zeros([TILE * TILE], tl.float32)
            seen = tl.zeros([1], tl.int64)
            for i in range(n_primitives):
                ball = balls + (hand * n_primitives + i) * 4
                r = tl.load(ball + 3)
                if r > 0:
                    bx, by, bz = tl.load(ball), tl.load(ball + 1), tl.load(ball + 2)
                    b = x * bx + y * by + bz
                    disc = b * b - square * (bx * bx + by * by + bz * bz - r * r)
                    met = disc > 0
                    root = tl.sqrt(tl.maximum(disc, 0.0))
                    first = tl.where(met, tl.minimum(first, (b - root) / square), first)
                    last = tl.where(met, tl.maximum(last, (b + root) / square), last)
                    bit = tl.full([1], 1, tl.int64) << i
                    seen = tl.where(tl.max(met.to(tl.int32)) > 0, seen | bit, seen)
            bits = tl.sum(seen)
            at = first
            going = (last > 0) & (first < z)
            # Where each ray was nearest to the skin, if it met it: one that grazes it goes on.
            skin_at = tl.full([TILE * TILE], 9.0, tl.float32)
            left_over = tl.full([TILE * TILE], 0.001, tl.float32)
            number = tl.zeros([TILE * TILE], tl.int32)
            steps = 0
            left = tl.max(going.to(tl.int32))
            while (steps < 32) & (left > 0):
                union = tl.full([TILE * TILE], 1.0, tl.float32)
                nearest = tl.full([TILE * TILE], 1.0, tl.float32)
                which_one = tl.zeros([TILE * TILE], tl.int32)
                for i in range(n_primitives):
                    if ((bits >> i) & 1) == 1:
                        primitive = primitives + (hand * n_primitives + i) * 17
                        d = _primitive_distance(primitive, at * x, at * y, at)
                        gap = tl.maximum(wide - tl.abs(union - d), 0.0)
                        union = tl.minimum(union, d) - gap * gap / (4.0 * wide)
                        which_one = tl.where(d < nearest, i, which_one)
                        nearest = tl.minimum(nearest, d)
                union = union - outside
                off = tl.abs(union)
                nearer = going & (off < left_over)
                goes = (skin_at == 9.0) | (off < 0.001)
                at = tl.where(going, at + union / norm, at)
                skin_at = tl.where(nearer, at, skin_at)
                number = tl.where(nearer, which_one, number)
                left_over = tl.where(nearer, off, left_over)
                going = going & (off >= 0.0002) & (at <= last) & goes
                left = tl.max(going.to(tl.int32))
                steps += 1
            on_skin = (skin_at < 9.0) & (skin_at < z)
            z = tl.where(on_skin, skin_at, z)
            its = tl.load(whose + hand * n_primitives + number, mask=on_skin, other=0)
            label = tl.where(on_skin, its.to(tl.int32), label)
        inside = (v < height) & (u < width)
        place = n * height_all * width_all + v * width_all + u
        tl.store(depth + place, z, mask=inside)
        tl.store(labels + place, label.to(tl.int8), mask=inside)


@triton.jit
def _block(lenses, width_all, BLOCK: tl.constexpr):
    """A program's picture, its pixels, and which of them lie inside of what the picture fills."""
    n = tl.program_id(1).to(tl.int64)
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    v, u = place // width_all, place % width_all
    width = tl.load(lenses + n * 5 + 3).to(tl.int32)
    height = tl.load(lenses + n * 5 + 4).to(tl.int32)
    return n, place, v, u, width, height, (v < height) & (u < width)


@triton.jit
def extreme_kernel(
    image, out, reaches, lenses, height_all, width_all,
    FARTHEST_ONE: tl.constexpr, DOWN: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The nearest (or farthest) depth within `reach` pixels along rows, or down columns."""
    n, place, v, u, width, height, inside = _block(lenses, width_all, BLOCK)
    reach = tl.load(reaches + n)
    if reach > 0:
        first = n * height_all * width_all
        best = tl.load(image + first + place, mask=inside, other=0.0)
        for shift in range(-reach, reach + 1):
            at, size, step = u + shift, width, shift
            if DOWN:
                at, size, step = v + shift, height, shift * width_all
            there = inside & (at >= 0) & (at < size)
            other = tl.load(image + first + place + step, mask=there, other=0.0)
            if FARTHEST_ONE:
                best = tl.where(there & (other > best), other, best)
            else:
                best = tl.where(there & (other < best), other, best)
        tl.store(out + first + place, best, mask=inside)


@triton.jit
def sense_kernel(
    clean, labels, sensors, seeds, lenses, out, height_all, width_all,
    TERMS: tl.constexpr, NOISE: tl.constexpr, FLYING: tl.constexpr, BIAS: tl.constexpr,
    HOLES: tl.constexpr, STEP: tl.constexpr, RANGE: tl.constexpr, BLUR: tl.constexpr,
    DARK: tl.constexpr, FOREARM: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Mixed pixels, range, missing ones, noise and steps, see pictures._sense."""
    n, place, v, u, width, height, inside = _block(lenses, width_all, BLOCK)
    first = n * height_all * width_all
    sensor, seed = sensors + n * TERMS, tl.load(seeds + n)
    down, along, mixes, mixed = tl.rand4x(seed, place)
    missing, r1, r2, r3 = tl.rand4x(seed, place + height_all * width_all)
    z = tl.load(clean + first + place, mask=inside, other=1.0)
    v2 = tl.minimum(tl.maximum(v + (down * 3).to(tl.int32) - 1, 0), height - 1)
    u2 = tl.minimum(tl.maximum(u + (along * 3).to(tl.int32) - 1, 0), width - 1)
    other = tl.load(clean + first + v2 * width_all + u2, mask=inside, other=1.0)
    gap = tl.abs(other - z)
    flies = (gap > 0.02) & (mixes < tl.load(sensor + FLYING))
    blurs = tl.where(gap <= 0.02, tl.load(sensor + BLUR), 0.0) > 0
    z = tl.where(flies, z + mixed * (tl.minimum(other, z + 2.0) - z), z)
    z = tl.where(blurs, 0.5 * (z + other), z)
    label = tl.load(labels + first + place, mask=inside, other=0).to(tl.int32)
    gone = tl.where(label == FOREARM, tl.load(sensor + DARK), 0.0) > 0
    gone = gone | (z > tl.load(sensor + RANGE)) | (missing < tl.load(sensor + HOLES))
    ratio = tl.minimum(z * z * 4.0, 20.0)
    # The sum of three uniforms, with deviation 1.
    normal = (r1 + r2 + r3 - 1.5) * 2.0
    z = z + tl.load(sensor + BIAS) + tl.load(sensor + NOISE) * ratio * normal
    step = tl.load(sensor + STEP) * ratio
    z = tl.where(step > 0, tl.floor(z / tl.maximum(step, 1e-9) + 0.5) * step, z)
    z = tl.where(gone, 0.0, tl.maximum(z, 0.0))
    tl.store(out + first + place, z, mask=inside)


@triton.jit
def smooth_kernel(
    image, out, reaches, lenses, height_all, width_all, SURFACE: tl.constexpr, BLOCK: tl.constexpr
):
    """See pictures._smooth; images with a reach of 0 are copied."""
    n, place, v, u, width, height, inside = _block(lenses, width_all, BLOCK)
    first = n * height_all * width_all
    reach = tl.load(reaches + n)
    z = tl.load(image + first + place, mask=inside, other=0.0)
    total = tl.zeros([BLOCK], tl.float32)
    count = tl.zeros([BLOCK], tl.float32)
    for down in range(-reach, reach + 1):
        for along in range(-reach, reach + 1):
            there = inside & (v + down >= 0) & (v + down < height)
            there = there & (u + along >= 0) & (u + along < width)
            step = down * width_all + along
            other = tl.load(image + first + place + step, mask=there, other=0.0)
            near = (other > 0) & (tl.abs(other - z) < SURFACE)
            total += tl.where(near, other, 0.0)
            count += tl.where(near, 1.0, 0.0)
    z = tl.where((z > 0) & (count > 0), total / tl.maximum(count, 1.0), z)
    tl.store(out + first + place, z, mask=inside)


@triton.jit
def finish_kernel(
    image, clean, sensors, patches, seeds, lenses, height_all, width_all,
    TERMS: tl.constexpr, COARSE: tl.constexpr, SHADOW: tl.constexpr, PATCHES: tl.constexpr,
    MOST_SHADOW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Coarse steps, shadows and patches, in place; patches: (N, 4, 3) uniforms."""
    n, place, v, u, width, height, inside = _block(lenses, width_all, BLOCK)
    first = n * height_all * width_all
    sensor = sensors + n * TERMS
    z = tl.load(image + first + place, mask=inside, other=0.0)
    coarse = tl.load(sensor + COARSE)
    if coarse > 0:
        z = tl.floor(z / coarse + 0.5) * coarse
    shadow = tl.load(sensor + SHADOW).to(tl.int32)
    if shadow > 0:
        here = tl.load(clean + first + place, mask=inside, other=0.0)
        for back in range(0, MOST_SHADOW + 1):
            edge = inside & (u + back < width - 1)
            far = tl.load(clean + first + place + back, mask=edge, other=0.0)
            near = tl.load(clean + first + place + back + 1, mask=edge, other=0.0)
            reach = (shadow * tl.minimum((far - near) * 3.0, 1.0)).to(tl.int32)
            dark = edge & (far - near > 0.03) & (reach >= back) & (here > near + 0.02)
            z = tl.where(dark, 0.0, z)
    count = tl.load(sensor + PATCHES).to(tl.int32)
    if count > 0:
        seed = tl.load(seeds + n)
        for patch in range(0, count):
            drawn = patches + (n * 4 + patch) * 3
            radius = 2.0 + tl.load(drawn) * 0.08 * width
            dv = v - (tl.load(drawn + 1) * height).to(tl.int32)
            du = u - (tl.load(drawn + 2) * width).to(tl.int32)
            ragged = tl.rand(seed, place + (2 + patch) * height_all * width_all)
            hole = (dv * dv + du * du) < radius * radius * (0.6 + 0.6 * ragged)
            z = tl.where(hole, 0.0, z)
    tl.store(image + first + place, z, mask=inside)


@triton.jit
def _sampled(x, y, border, cosine, sine, middle, each, last):
    """Where a sample across the crop lies in the picture, and whether it is in the image."""
    a, b = cosine * x - sine * y, sine * x + cosine * y
    in_one = tl.load(border) * a + tl.load(border + 1) * b < tl.load(border + 2)
    in_both = in_one & (tl.load(border + 3) * a + tl.load(border + 4) * b < tl.load(border + 5))
    v = tl.minimum(tl.maximum((middle + b * each).to(tl.int32), 0), last)
    u = tl.minimum(tl.maximum((middle + a * each).to(tl.int32), 0), last)
    return v, u, in_both


@triton.jit
def read_kernel(
    depth, sides, distances, angles, borders, image, height_all, width_all,
    SCALE: tl.constexpr, CROP: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Crops of pictures, see images_numba._read."""
    n = tl.program_id(1).to(tl.int64)
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row, column = place // CROP, place % CROP
    whole, each = tl.load(sides + n * 2), tl.load(sides + n * 2 + 1)
    cosine, sine = tl.cos(tl.load(angles + n)), tl.sin(tl.load(angles + n))
    border, distance = borders + n * 6, tl.load(distances + n)
    out = image + n * CHANNELS * CROP * CROP + place
    total = tl.zeros([BLOCK], tl.float32)
    near = tl.zeros([BLOCK], tl.float32)
    count = tl.zeros([BLOCK], tl.float32)
    outside = tl.zeros([BLOCK], tl.float32)
    for reading in tl.static_range(4):
        y = (2 * row + reading // 2 + 0.5) / (2 * CROP) - 0.5
        x = (2 * column + reading % 2 + 0.5) / (2 * CROP) - 0.5
        v, u, inside = _sampled(x, y, border, cosine, sine, 0.5 * whole, each, whole - 1)
        at = depth + n * height_all * width_all + v * width_all + u
        z = tl.load(at, mask=inside, other=0.0)
        read = z > 0
        relative = (z - distance) * SCALE
        clipped = tl.minimum(tl.maximum(relative, -1.0), 1.0)
        total += tl.where(read, clipped, 0.0)
        near += tl.where(read & (tl.abs(relative) < 1), 0.25, 0.0)
        count += tl.where(read, 1.0, 0.0)
        outside += tl.where(inside, 0.0, 0.25)
        tl.store(out + (4 + reading) * CROP * CROP, tl.where(read, clipped, 1.0))
    tl.store(out, tl.where(count > 0, total / tl.maximum(count, 1.0), 1.0))
    tl.store(out + CROP * CROP, near)
    tl.store(out + 2 * CROP * CROP, 1 - 0.25 * count)
    tl.store(out + 3 * CROP * CROP, outside)


@triton.jit
def parts_kernel(
    labels, sides, angles, borders, image, parts, height_all, width_all,
    CROP: tl.constexpr, CHANNELS: tl.constexpr, PARTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """What the crop shows in each of PARTS x PARTS places, -1 = not in the image."""
    n = tl.program_id(1).to(tl.int64)
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    each_part: tl.constexpr = CROP // PARTS
    line = 2 * each_part * (place // PARTS) + each_part
    sample = 2 * each_part * (place % PARTS) + each_part
    whole, each = tl.load(sides + n * 2), tl.load(sides + n * 2 + 1)
    cosine, sine = tl.cos(tl.load(angles + n)), tl.sin(tl.load(angles + n))
    y, x = (line + 0.5) / (2 * CROP) - 0.5, (sample + 0.5) / (2 * CROP) - 0.5
    v, u, inside = _sampled(x, y, borders + n * 6, cosine, sine, 0.5 * whole, each, whole - 1)
    at = labels + n * height_all * width_all + v * width_all + u
    shown = tl.load(at, mask=inside, other=-1).to(tl.int64)
    cut = image + (n * CHANNELS + 3) * CROP * CROP + line // 2 * CROP + sample // 2
    shown = tl.where(tl.load(cut) > 0.5, -1, shown)
    tl.store(parts + n * PARTS * PARTS + place, shown)
