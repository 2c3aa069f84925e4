"""Skin in a depth picture: a smooth union of cones and ellipsoids, met by walking along rays.

From a point at a signed distance d from a surface nothing is met for d metres ("sphere tracing",
Hart, The Visual Computer 12(10), 1996). Distances of ellipsoids and of flattened cones are only
nearly right, so the walk goes back where it went too far. It first goes with the bundle of all rays
of a tile of TILE x TILE pixels, then with each of them, whose arithmetic is vectorised.
"""

from __future__ import annotations

import math

import numpy as np

from toftrack.compute.compiling import compiled
from toftrack.training.things_numba import CORNER, MIDDLE, TILE, seen_between

_STEPS = 12
_NEAR_M = np.float32(0.001)
"""A ray that is so near has met the skin."""
_HALF, _QUARTER, _ONE, _FOUR = np.float32(0.5), np.float32(0.25), np.float32(1), np.float32(4)
_TINY = np.float32(1e-9)
_CAREFUL = np.float32(0.85)
"""Of the distances, how far surely nothing is met."""


@compiled
def _numbers(p, i):
    """Of a hand's primitive number i, see skin.PRIMITIVE: read once, as a loop that writes arrays
    would read them again and again.
    """
    return (
        *(p[i, 0], p[i, 1], p[i, 2], p[i, 3], p[i, 4], p[i, 5], p[i, 6], p[i, 7], p[i, 8]),
        *(p[i, 9], p[i, 10], p[i, 11], p[i, 12], p[i, 13], p[i, 14], p[i, 15], p[i, 16]),
    )


@compiled
def _distance(q, x, y, z):
    """From a point to a primitive, see _numbers; each kind without branches, for vectors."""
    x, y, z = x - q[0], y - q[1], z - q[2]
    a = q[3] * x + q[4] * y + q[5] * z
    b = q[6] * x + q[7] * y + q[8] * z
    c = q[9] * x + q[10] * y + q[11] * z
    if q[14] >= 0:
        first, second, length, slope, rise = q[12], q[13], q[14], q[15], q[16]
        square, beyond = a * a + c * c, b - length
        across = math.sqrt(square)
        along = rise * b - slope * across
        start = math.sqrt(square + b * b) - first
        end = math.sqrt(square + beyond * beyond) - second
        side = across * rise + b * slope - first
        return start if along < 0 else (end if along > rise * length else side)
    norm = math.sqrt(a * a + b * b + c * c)
    gx = q[3] * a + q[6] * b + q[9] * c
    gy = q[4] * a + q[7] * b + q[10] * c
    gz = q[5] * a + q[8] * b + q[11] * c
    return norm * (norm - _ONE) / (math.sqrt(gx * gx + gy * gy + gz * gz) + _TINY)


@compiled
def draw_skin(skin, lens, depth, labels, work):
    """A hand's skin into the depth buffer.

    skin: primitives, labels (P,), -1 = none, blend and outside, see skin.Skins.
    work: balls (P, 4), lists (tiles, P), counts (tiles,), on and near (P,), and rays, six arrays
    (TILE * TILE,), to work in.
    """
    primitives, whose, blend, outside = skin
    balls, lists, counts, on, near, rays = work
    width, height = int(lens[3]), int(lens[4])
    f = lens[0]
    xs, ys, zs, union, nearest, which = rays
    wide = np.float32(2.77) * blend  # the union's polynomial then grows by 0.7 `blend` at a joint
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
        left, right = seen_between(x, z, r * r, np.float32(0), r * r, f, lens[1], width)
        top, bottom = seen_between(y, z, r * r, np.float32(0), r * r, f, lens[2], height)
        for row in range(top // TILE, bottom // TILE + 1):
            for column in range(left // TILE, right // TILE + 1):
                tile = row * columns + column
                lists[tile, counts[tile]] = i
                counts[tile] += 1
    for tile in range(rows * columns):
        if counts[tile] > 0:
            top, left = tile // columns * TILE, tile % columns * TILE
            x = (np.float32(left) + MIDDLE - lens[1]) / f
            y = (np.float32(top) + MIDDLE - lens[2]) / f
            here = lists[tile, : counts[tile]]
            apart = CORNER / f
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
            found, span = (zs, union, nearest, which), (first, last, apart * first)
            _meet_skin(primitives, on, near, count, (xs, ys), found, span, wide, outside)
            for ray in range(TILE * TILE):
                v, u = top + ray // TILE, left + ray % TILE
                if v < height and u < width and abs(union[ray]) < _NEAR_M:
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
        bx, by, bz = balls[i, 0], balls[i, 1], balls[i, 2]
        b = x * bx + y * by + bz
        c = bx * bx + by * by + bz * bz - r * r
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
            d = _distance(_numbers(primitives, i), x, y, z)
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
        if free < _NEAR_M:
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
        d = _distance(_numbers(primitives, i), x, y, z)
        at = k
        while at > 0 and near[at - 1] > d:
            near[at], on[at] = near[at - 1], on[at - 1]
            at -= 1
        near[at], on[at] = d, i


@compiled
def _meet_skin(primitives, on, near, count, rays, found, span, wide, outside):
    """Where a tile's rays meet the skin: z, and what is near there, in `found`.

    rays: x and y of each at z = 1.  found: z, distance that is left, nearest primitive.
    span: the first z and the last, and how far rays are apart at the first.
    All rays go together, so that their arithmetic is done at once.
    """
    first, last, apart = span
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
            _join(primitives, on[k], rays, found, wide)
            most = -_ONE
            for ray in range(len(xs)):
                most = max(most, union[ray] if zs[ray] <= last else -_ONE)
        going = 0
        for ray in range(len(xs)):
            union[ray] -= outside
            far = abs(union[ray]) > _NEAR_M
            inside = zs[ray] <= last
            zs[ray] += union[ray] / norm if inside else np.float32(0)
            going += far & inside
        if going == 0:
            break


@compiled
def _join(primitives, i, rays, found, wide):
    """One more primitive, number i, in the union of _meet_skin."""
    xs, ys = rays
    zs, union, nearest, which = found
    q, number, scale = _numbers(primitives, i), np.float32(i), _QUARTER / wide
    for ray in range(len(xs)):
        z = zs[ray]
        d = _distance(q, z * xs[ray], z * ys[ray], z)
        u = union[ray]
        gap = wide - abs(u - d)
        gap = gap if gap > 0 else np.float32(0)
        union[ray] = (d if d < u else u) - gap * gap * scale
        closer = d < nearest[ray]
        which[ray] = number if closer else which[ray]
        nearest[ray] = d if closer else nearest[ray]
