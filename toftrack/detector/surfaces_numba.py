"""Surfaces that are met by walking along rays: smooth unions, and things by signed distances.

From a point at a signed distance d from a surface nothing is met for d metres ("sphere tracing",
Hart, The Visual Computer 12(10), 1996). Distances of ellipsoids and of flattened cones are only
nearly right, so the walk goes back where it went too far.
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
TILE = 4
_MIDDLE, _CORNER = np.float32(1.5), np.float32(2.13)
"""Of a tile, pixels: its side, middle, and how far a corner is from that."""
_STEPS, _MOST_STEPS = 12, 48
_NEAR_M, _NEAR_ENOUGH_M = np.float32(0.0004), np.float32(0.001)
_HALF, _QUARTER, _ONE, _FOUR = np.float32(0.5), np.float32(0.25), np.float32(1), np.float32(4)
_TINY = np.float32(1e-9)
_CAREFUL = np.float32(0.85)
"""Of the distances, how far surely nothing is met."""


@compiled
def _cone_distance(across, y, first, second, length, slope, rise):
    """Of a round cone along y from 0 to `length`; slope, rise: sine and cosine of its opening."""
    along = rise * y - slope * across
    if along < 0:
        return math.sqrt(across * across + y * y) - first
    if along > rise * length:
        return math.sqrt(across * across + (y - length) * (y - length)) - second
    return across * rise + y * slope - first


@compiled
def _primitive_distance(p, i, x, y, z):
    """Of a hand's primitive number i, see skin.PRIMITIVE."""
    x, y, z = x - p[i, 0], y - p[i, 1], z - p[i, 2]
    a = p[i, 3] * x + p[i, 4] * y + p[i, 5] * z
    b = p[i, 6] * x + p[i, 7] * y + p[i, 8] * z
    c = p[i, 9] * x + p[i, 10] * y + p[i, 11] * z
    if p[i, 14] >= 0:
        across = math.sqrt(a * a + c * c)
        return _cone_distance(across, b, p[i, 12], p[i, 13], p[i, 14], p[i, 15], p[i, 16])
    norm = math.sqrt(a * a + b * b + c * c)
    gx = p[i, 3] * a + p[i, 6] * b + p[i, 9] * c
    gy = p[i, 4] * a + p[i, 7] * b + p[i, 10] * c
    gz = p[i, 5] * a + p[i, 8] * b + p[i, 11] * c
    return norm * (norm - _ONE) / (math.sqrt(gx * gx + gy * gy + gz * gz) + _TINY)


@compiled
def _ball_box(x, z, r, f, middle, size):
    """First and last pixel, along one axis, of a ball in front of the camera."""
    w = 1 / (z * z - r * r)
    at = x * z * w
    half = math.sqrt(max(at * at - (x * x - r * r) * w, 0.0))
    first = max(0, math.ceil((at - half) * f + middle))
    return first, min(size - 1, math.floor((at + half) * f + middle))


@compiled
def draw_skin(
    primitives, whose, blend, outside, lens, depth, labels, balls, lists, counts, on, near, rays
):
    """A hand's skin into the depth buffer, see skin.Skins; whose: (P,) labels, -1 = none.

    balls: (P, 4), lists: (tiles, P), counts: (tiles,), on and near: (P,), and rays: six arrays
    (TILE * TILE,), to work in.
    """
    width, height = int(lens[3]), int(lens[4])
    f = lens[0]
    xs, ys, zs, union, nearest, which = rays
    wide = np.float32(2.77) * blend  # the union's polynomial then grows by `blend` at a joint
    margin = max(outside, np.float32(0)) + np.float32(1.5) * blend
    columns = (width + TILE - 1) // TILE
    rows = (height + TILE - 1) // TILE
    counts[: rows * columns] = 0
    for i in range(len(primitives)):
        if whose[i] < 0:
            continue
        p = primitives[i]
        radius, half = p[12], np.float32(0)
        if p[14] >= 0:
            radius, half = max(p[12], p[13]) * np.float32(1.1), _HALF * p[14]
        norm = math.sqrt(p[6] * p[6] + p[7] * p[7] + p[8] * p[8])
        shift = half / norm
        r = radius + half + margin
        x, y, z = p[0] + shift * p[6], p[1] + shift * p[7], p[2] + shift * p[8]
        balls[i, 0], balls[i, 1], balls[i, 2], balls[i, 3] = x, y, z, r
        if z - r < 0.05:
            continue
        left, right = _ball_box(x, z, r, f, lens[1], width)
        top, bottom = _ball_box(y, z, r, f, lens[2], height)
        for row in range(top // TILE, bottom // TILE + 1):
            for column in range(left // TILE, right // TILE + 1):
                tile = row * columns + column
                lists[tile, counts[tile]] = i
                counts[tile] += 1
    for tile in range(rows * columns):
        if counts[tile] > 0:
            top, left = tile // columns * TILE, tile % columns * TILE
            x, y = (
                (np.float32(left) + _MIDDLE - lens[1]) / f,
                (np.float32(top) + _MIDDLE - lens[2]) / f,
            )
            here = lists[tile, : counts[tile]]
            apart = _CORNER / f
            count, first, last = _met_balls(balls, here, on, x, y, apart)
            if count == 0:
                continue
            first = _before_skin(
                primitives, balls, on, count, x, y, first, last, apart, wide, outside
            )
            if first > last:
                continue
            _sort_by_distance(primitives, on, count, first * x, first * y, first, near)
            for ray in range(TILE * TILE):
                xs[ray] = (np.float32(left + ray % TILE) - lens[1]) / f
                ys[ray] = (np.float32(top + ray // TILE) - lens[2]) / f
            _meet_skin(
                primitives,
                on,
                near,
                count,
                (xs, ys),
                (zs, union, nearest, which),
                first,
                last,
                apart * first,
                wide,
                outside,
            )
            for ray in range(TILE * TILE):
                v, u = top + ray // TILE, left + ray % TILE
                if v < height and u < width and abs(union[ray]) < _NEAR_ENOUGH_M:
                    if zs[ray] < depth[v, u]:
                        depth[v, u] = zs[ray]
                        labels[v, u] = whose[int(which[ray])]


@compiled
def _met_balls(balls, here, on, x, y, apart):
    """Which balls, into `on`, a bundle of rays about z (x, y, 1) meets: how many, and from where to
    where; apart: how far the rays are from the middle one at z = 1."""
    square = x * x + y * y + _ONE
    count, first, last = 0, np.float32(9), np.float32(0)
    for i in here:
        r = balls[i, 3] + apart * balls[i, 2]
        b = x * balls[i, 0] + y * balls[i, 1] + balls[i, 2]
        c = (
            balls[i, 0] * balls[i, 0]
            + balls[i, 1] * balls[i, 1]
            + balls[i, 2] * balls[i, 2]
            - r * r
        )
        disc = b * b - square * c
        if disc > 0:
            root = math.sqrt(disc)
            first = min(first, (b - root) / square)
            last = max(last, (b + root) / square)
            on[count] = i
            count += 1
    return count, first, last


@compiled
def _union(primitives, balls, on, count, x, y, z, wide):
    """Signed distance of the smooth union."""
    union = _ONE
    for k in range(count):
        i = on[k]
        dx, dy, dz = x - balls[i, 0], y - balls[i, 1], z - balls[i, 2]
        far = union + wide + balls[i, 3]
        if dx * dx + dy * dy + dz * dz < far * far:
            d = _primitive_distance(primitives, i, x, y, z)
            gap = wide - abs(union - d)
            union = min(union, d)
            if gap > 0:
                union -= gap * gap / (_FOUR * wide)
    return union


@compiled
def _before_skin(primitives, balls, on, count, x, y, z, last, apart, wide, outside):
    """How far all rays of a bundle about z (x, y, 1) can go before any meets the skin."""
    inverse = _CAREFUL / math.sqrt(x * x + y * y + _ONE)
    for _ in range(_STEPS):
        union = _union(primitives, balls, on, count, z * x, z * y, z, wide)
        free = union - outside - apart * z
        if free < _NEAR_ENOUGH_M:
            return z + min(free, np.float32(0)) * _HALF
        z += free * inverse
        if z > last:
            break
    return z


@compiled
def _sort_by_distance(primitives, on, count, x, y, z, near):
    """Primitives by their distances, `near`, from a point."""
    for k in range(count):
        i = on[k]
        d = _primitive_distance(primitives, i, x, y, z)
        at = k
        while at > 0 and near[at - 1] > d:
            near[at], on[at] = near[at - 1], on[at - 1]
            at -= 1
        near[at], on[at] = d, i


@compiled
def _meet_skin(primitives, on, near, count, rays, found, first, last, apart, wide, outside):
    """Where a tile's rays meet the skin, from `first` on: z, and what is near there, in `found`.

    rays: x and y of each at z = 1.  found: z, distance that is left, nearest primitive.
    All rays go together, so that their arithmetic is done at once.
    """
    xs, ys = rays
    zs, union, nearest, which = found
    zs[:] = first
    norm = math.sqrt(xs[0] * xs[0] + ys[0] * ys[0] + _ONE)
    for _ in range(_STEPS):
        union[:] = _ONE
        nearest[:] = _ONE
        farthest = first
        for ray in range(len(xs)):
            farthest = max(farthest, min(zs[ray], last))
        gone = apart + (farthest - first) * norm
        most = _ONE
        for k in range(count):
            # No nearer than this, whatever the direction.
            if _CAREFUL * near[k] - gone > most + wide:
                break
            i = on[k]
            if primitives[i, 14] >= 0:
                _join_cone(primitives, i, xs, ys, zs, wide, union, nearest, which)
            else:
                _join_ellipsoid(primitives, i, xs, ys, zs, wide, union, nearest, which)
            most = -_ONE
            for ray in range(len(xs)):
                most = max(most, union[ray] if zs[ray] <= last else -_ONE)
        going = 0
        for ray in range(len(xs)):
            union[ray] -= outside
            far = abs(union[ray]) > _NEAR_ENOUGH_M
            inside = zs[ray] <= last
            zs[ray] += union[ray] / norm if inside else np.float32(0)
            going += far & inside
        if going == 0:
            break


@compiled
def _join_cone(p, i, xs, ys, zs, wide, union, nearest, which):
    """One more primitive in the union of _meet_skin, a cone."""
    x0, y0, z0 = p[i, 0], p[i, 1], p[i, 2]
    a0, a1, a2 = p[i, 3], p[i, 4], p[i, 5]
    b0, b1, b2 = p[i, 6], p[i, 7], p[i, 8]
    c0, c1, c2 = p[i, 9], p[i, 10], p[i, 11]
    first, second, length, slope, rise = p[i, 12], p[i, 13], p[i, 14], p[i, 15], p[i, 16]
    scale = _QUARTER / wide
    number = np.float32(i)
    for ray in range(len(xs)):
        z = zs[ray]
        x, y, z = z * xs[ray] - x0, z * ys[ray] - y0, z - z0
        a = a0 * x + a1 * y + a2 * z
        b = b0 * x + b1 * y + b2 * z
        c = c0 * x + c1 * y + c2 * z
        square = a * a + c * c
        across = math.sqrt(square)
        beyond = b - length
        along = rise * b - slope * across
        side = across * rise + b * slope - first
        start = math.sqrt(square + b * b) - first
        end = math.sqrt(square + beyond * beyond) - second
        d = start if along < 0 else (end if along > rise * length else side)
        u = union[ray]
        gap = wide - abs(u - d)
        gap = gap if gap > 0 else np.float32(0)
        union[ray] = (d if d < u else u) - gap * gap * scale
        closer = d < nearest[ray]
        which[ray] = number if closer else which[ray]
        nearest[ray] = d if closer else nearest[ray]


@compiled
def _join_ellipsoid(p, i, xs, ys, zs, wide, union, nearest, which):
    """One more primitive in the union of _meet_skin, an ellipsoid."""
    x0, y0, z0 = p[i, 0], p[i, 1], p[i, 2]
    a0, a1, a2 = p[i, 3], p[i, 4], p[i, 5]
    b0, b1, b2 = p[i, 6], p[i, 7], p[i, 8]
    c0, c1, c2 = p[i, 9], p[i, 10], p[i, 11]
    scale = _QUARTER / wide
    number = np.float32(i)
    for ray in range(len(xs)):
        z = zs[ray]
        x, y, z = z * xs[ray] - x0, z * ys[ray] - y0, z - z0
        a = a0 * x + a1 * y + a2 * z
        b = b0 * x + b1 * y + b2 * z
        c = c0 * x + c1 * y + c2 * z
        norm = math.sqrt(a * a + b * b + c * c)
        gx, gy, gz = a0 * a + b0 * b + c0 * c, a1 * a + b1 * b + c1 * c, a2 * a + b2 * b + c2 * c
        d = norm * (norm - _ONE) / (math.sqrt(gx * gx + gy * gy + gz * gz) + _TINY)
        u = union[ray]
        gap = wide - abs(u - d)
        gap = gap if gap > 0 else np.float32(0)
        union[ray] = (d if d < u else u) - gap * gap * scale
        closer = d < nearest[ray]
        which[ray] = number if closer else which[ray]
        nearest[ray] = d if closer else nearest[ray]


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
    """A thing's part into the depth buffer."""
    x0, y0, z0, r = part[1], part[2], part[3], part[18]
    if z0 - r < 0.05:
        return
    left, right = _ball_box(x0, z0, r, lens[0], lens[1], int(lens[3]))
    top, bottom = _ball_box(y0, z0, r, lens[0], lens[2], int(lens[4]))
    c = x0 * x0 + y0 * y0 + z0 * z0 - r * r
    for v in range(top, bottom + 1):
        y = (np.float32(v) - lens[2]) / lens[0]
        for u in range(left, right + 1):
            x = (np.float32(u) - lens[1]) / lens[0]
            square = x * x + y * y + 1
            b = x * x0 + y * y0 + z0
            disc = b * b - square * c
            if disc <= 0:
                continue
            root = math.sqrt(disc)
            z, last = (b - root) / square, (b + root) / square
            norm = math.sqrt(square)
            for _ in range(_MOST_STEPS):
                if z > last or z >= depth[v, u]:
                    break
                d = part_distance(part, z * x, z * y, z)
                if d < _NEAR_M:
                    depth[v, u] = z
                    labels[v, u] = label
                    break
                z += max(d, 0.0002) / norm
