"""The fused CPU kernel: from a state of 27 numbers to four counts, one particle at a time.

Each ellipsoid is drawn into a tile that holds one hand, only over the exact span of its outline in
each row; then the tile is compared with the evidence, which leaves the silhouette as rows of bits.
"""

from __future__ import annotations

import math
import zlib
from pathlib import Path

import numba
import numpy as np

from toftrack.render.numba_hand import (
    DU,
    DX,
    HX,
    HY,
    IY,
    LANES,
    TERMS,
    UX,
    UY,
    XY,
    U,
    X,
    Y,
    pose_hands,
    project_hands,
)
from toftrack.render.numba_vector import BLOCK, OPTIONS, compiled, count, draw, ones, take

_SOURCES = ("numba_hand.py", "numba_kernel.py", "numba_vector.py")


def _cached(function):
    """Decorator of the kernel's entry points: compiled at the first call, or taken from the cache."""
    # numba's cache notices changes of the function's own file only, but it does go by the name.
    sources = b"".join(Path(__file__).with_name(name).read_bytes() for name in _SOURCES)
    function.__qualname__ += f"_{zlib.crc32(sources):08x}"
    try:
        return numba.njit(cache=True, **OPTIONS)(function)
    except RuntimeError:  # there is no place to write to
        return numba.njit(**OPTIONS)(function)


_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_FIELD = np.uint64((1 << BLOCK) - 1)


@compiled
def _run(first, last):
    """A word with bits first .. last set, as far as they lie within it."""
    first, last = max(first, 0), min(last, 63)
    if last < first:
        return np.uint64(0)
    return (~np.uint64(0) >> np.uint64(63 - (last - first))) << np.uint64(first)


@compiled
def _clip(value, size):
    """A float as an integer in 0 .. size; 0 for NaN."""
    if not value > _ZERO:
        return 0
    return size if value >= size else int(value)


@compiled
def _box(conics, i, width, height):
    """First and one-past-last column and row of all ellipsoids but the wrist's, in the image."""
    left, top, right, bottom = width, height, 0, 0
    for e in range(conics.shape[0] - 1):
        high = conics[e, HY * LANES + i]
        if high > _ZERO:
            x, wide, y = conics[e, X * LANES + i], conics[e, HX * LANES + i], conics[e, Y * LANES + i]
            left = min(left, _clip(np.ceil(x - wide), width))
            right = max(right, _clip(np.floor(x + wide) + _ONE, width))
            top = min(top, _clip(np.ceil(y - high), height))
            bottom = max(bottom, _clip(np.floor(y + high) + _ONE, height))
    return left, top, right, bottom


@compiled
def _render(conics, i, box, origin, stride, tile, spans, lines):
    """The largest inverse depth of each pixel of the box, 0 = none.

    tile: flat, rows of `stride` pixels from row `top` and column `origin` of the image.
    spans: (2 * R,) set to the first and, from R on, the last tile column drawn in each row.
    lines: (5, R) scratch.
    """
    left, top, right, bottom = box
    # Whole blocks, and one more that the last drawn block may reach into.
    begin = (left - origin) // BLOCK * BLOCK
    end = ((right - origin) // BLOCK + 2) * BLOCK
    firsts, lasts = spans
    for row in range(bottom - top):
        clear(tile, row * stride + begin, end - begin)
    for row in range(bottom - top + ROWS):
        firsts[row], lasts[row] = stride, -1
    low_most, high_most = np.float32(left - origin), np.float32(right - 1 - origin)
    for e in range(conics.shape[0] - 1):
        conic = conics[e]
        high = conic[HY * LANES + i]
        if not high > _ZERO:
            continue
        x, y = conic[X * LANES + i] - np.float32(origin), conic[Y * LANES + i]
        first = max(_clip(np.ceil(y - high), bottom), top)
        rows = _clip(y + high + _ONE, bottom) - first
        lead = np.float32(first) - y
        du, dx = conic[DU * LANES + i], conic[DX * LANES + i]
        curve, slope = du / dx, conic[UX * LANES + i]
        for row in range(0, rows, ROWS):
            outline(
                lines,
                firsts,
                lasts,
                first - top + row,
                rows - row,
                lead + np.float32(row),
                x,
                conic[XY * LANES + i],
                conic[IY * LANES + i],
                dx,
                low_most,
                high_most,
                conic[U * LANES + i],
                conic[UY * LANES + i],
                du,
            )
            at = (first - top + row) * stride
            for r in range(min(ROWS, rows - row)):
                draw_line(tile, at, lines, r, slope, curve)
                at += stride


@compiled
def _compare(tile, stride, spans, box, origin, images, model, above, residuals):
    """Counts of correct and false pixels of a tile, and the silhouette as bits.

    images: (3, H, >= W + BLOCK) low, high, occluder, such that nothing beyond W counts.
    model: (words + 2, ...) zeros; bits go to word 1.. by 64 columns and row `above`...
    """
    left, top, right, bottom = box
    _, height, pitch = images.shape
    correct, false = 0, 0
    for row in range(bottom - top):
        for block in range(spans[0, row] // BLOCK, spans[1, row] // BLOCK + 1):
            pixel = (top + row) * pitch + origin + block * BLOCK
            bits = count(
                tile,
                row * stride + block * BLOCK,
                images,
                pixel,
                pixel + height * pitch,
                pixel + 2 * height * pitch,
                residuals,
            )
            correct += ones((bits >> np.uint64(BLOCK)) & _FIELD)
            false += ones(bits >> np.uint64(2 * BLOCK))
            column = block * BLOCK
            # A block may reach past the image's edge.
            inside = bits & _FIELD & _run(0, right - 1 - origin - column)
            model[1 + (column >> 6), above + row] |= inside << np.uint64(column & 63)
    return correct, false


@compiled
def _dilate(model, here, there, words, halves, first, rows):
    """Exact Euclidean disc dilation of bit rows; the result is in the returned one of the buffers.

    A disc is a horizontal run for each row offset dy. Taken from the longest run to the shortest,
    each step widens all that came before by the difference (Horner's scheme).

    model: (words + 2, R) bit rows by word, with empty words around them; result row r is about
        model row first + r.  here, there: (words + 2, >= rows) buffers with empty words around.
    halves: (reach + 1,) half lengths of the runs.
    """
    reach = halves.shape[0] - 1
    one, last = np.uint64(1), np.uint64(63)
    for w in range(1, words + 1):
        source = model[w, first : first + rows]
        for r in range(rows):
            here[w, r] = source[r]
    for dy in range(1, reach + 2):
        grow = halves[dy - 1] - (halves[dy] if dy <= reach else 0)
        for _ in range(grow):
            for w in range(1, words + 1):
                for r in range(rows):
                    x = here[w, r]
                    carry = (here[w - 1, r] >> last) | (here[w + 1, r] << last)
                    there[w, r] = x | (x << one) | (x >> one) | carry
            here, there = there, here
        if dy <= reach:
            for w in range(1, words + 1):
                over = model[w, first - dy : first - dy + rows]
                under = model[w, first + dy : first + dy + rows]
                for r in range(rows):
                    here[w, r] |= over[r] | under[r]
    return here


@compiled
def _missed(conics, i, model, words, first_row, rows, origin, hand, halves, wanted, here, there):
    """Hand pixels near the silhouette but outside of it and of the wrist's.

    first_row, origin: the image row and column of model's row `reach` and word 1.
    hand: (H, words of a row + 1) bits of the evidence.
    """
    reach = halves.shape[0] - 1
    e = conics.shape[0] - 1
    x, y, high, shear = conics[e, X * LANES + i], conics[e, Y * LANES + i], conics[e, HY * LANES + i], conics[e, XY * LANES + i]
    inverse, dx = conics[e, IY * LANES + i], conics[e, DX * LANES + i]
    begin, end = rows, 0
    shift = np.uint64(origin & 63)
    for r in range(rows):
        v = first_row + r
        dy = np.float32(v) - y
        rest = _ONE - dy * dy * inverse
        wrist_first, wrist_last = 0, -1
        if high > _ZERO and rest >= _ZERO:
            middle, half = x + shear * dy, math.sqrt(dx * rest)
            wrist_first = _clip(np.ceil(middle - half), 1 << 20) - origin
            wrist_last = _clip(np.floor(middle + half) + _ONE, 1 << 20) - 1 - origin
        any_here = np.uint64(0)
        for w in range(words):
            at = (origin >> 6) + w
            bits = hand[v, at] >> shift
            if shift:
                bits |= hand[v, at + 1] << (np.uint64(64) - shift)
            bits &= ~model[w + 1, reach + r]
            bits &= ~_run(wrist_first - 64 * w, wrist_last - 64 * w)
            wanted[w, r] = bits
            any_here |= bits
        if any_here:
            begin, end = min(begin, r), r + 1
    if end <= begin:
        return 0
    near = _dilate(model, here, there, words, halves, reach + begin, end - begin)
    missed = 0
    for w in range(words):
        for r in range(begin, end):
            missed += ones(near[w + 1, r - begin] & wanted[w, r])
    return missed


@_cached
def pack_evidence(low, high, occluder, hand):
    """Evidence as (3, H, W + padding) float32 images and (H, words + 1) bits of the hand."""
    height, width = hand.shape
    pitch = (width + 2 * BLOCK - 1) // BLOCK * BLOCK
    images = np.empty((3, height, pitch), np.float32)
    bits = np.zeros((height, (width + 63) // 64 + 1), np.uint64)
    for v in range(height):
        for u in range(width):
            images[0, v, u] = low[v, u]
            images[1, v, u] = high[v, u]
            images[2, v, u] = occluder[v, u]
        for u in range(width, pitch):
            images[0, v, u] = np.inf
            images[1, v, u] = -np.inf
            images[2, v, u] = np.inf
        for u in range(width):
            bits[v, u >> 6] |= np.uint64(hand[v, u]) << np.uint64(u & 63)
    return images, bits


@_cached
def score_hands(
    states, k, images, hand, width, halves, slots, base, lengths, mirror, index, surface, counter, out
):
    """Score tasks of LANES particles as long as `counter` has any; called from several threads.

    states: (N, 27).  k: fx, fy, cx, cy.  images, hand: of pack_evidence, for `width` columns.
    halves: half lengths of the rows of the disc.  slots .. surface: see NumbaScorer.
    counter: (1,) int64 tasks taken.  out: (4, N) correct, false, missed, residual.
    """
    height, reach, parts = images.shape[1], halves.shape[0] - 1, hand.shape[1] - 1
    x = np.empty(27 * LANES, np.float32)
    sines, cosines = np.empty((2, 25 * LANES), np.float32)
    frames = np.empty((16, 12 * LANES), np.float32)
    valid = np.empty(LANES, np.uint8)
    conics = np.empty((index.shape[0], TERMS * LANES), np.float32)
    tile = np.empty(height * (64 * parts + 2 * BLOCK), np.float32)
    spans = np.empty((2, height), np.int64)
    residuals = np.empty(BLOCK, np.float32)
    model = np.empty((parts + 2, height + 2 * reach), np.uint64)
    here, there = np.zeros((2, parts + 2, height), np.uint64)
    wanted = np.empty((parts, height), np.uint64)
    while True:
        first = take(counter) * LANES
        if first >= states.shape[0]:
            break
        pose_hands(states, first, slots, base, lengths, mirror, x, sines, cosines, frames, valid)
        project_hands(frames, index, surface, k[0], k[1], k[2], k[3], conics)
        for i in range(min(LANES, states.shape[0] - first)):
            for j in range(4):
                out[j, first + i] = _ZERO
            box = _box(conics, i, width, height)
            left, top, right, bottom = box
            if not valid[i] or right <= left or bottom <= top:
                continue
            origin, first_row = max(0, left - reach), max(0, top - reach)
            rows = min(height, bottom + reach) - first_row
            words = (min(width, right + reach) - origin + 63) >> 6
            stride = 64 * words + 2 * BLOCK
            _render(conics, i, box, origin, stride, tile, spans)
            residuals[:] = _ZERO
            model[: words + 2, : rows + 2 * reach] = np.uint64(0)
            here[words + 1], there[words + 1] = np.uint64(0), np.uint64(0)
            above = reach + top - first_row
            correct, false = _compare(
                tile, stride, spans, box, origin, images, model, above, residuals
            )
            out[0, first + i], out[1, first + i] = correct, false
            out[2, first + i] = _missed(
                conics, i, model, words, first_row, rows, origin, hand, halves, wanted, here, there
            )
            out[3, first + i] = residuals.sum()
