"""The fused CPU kernel: from a state of 27 numbers to four counts, one particle at a time.

Each ellipsoid is drawn into a tile that holds one hand, only over the exact span of its outline in
each row; then the tile is compared with the evidence, which leaves the silhouette as rows of bits.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from toftrack.compute.compiling import compiled, entry_point, take
from toftrack.render.numba.hand import (
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
from toftrack.render.numba.vector import (
    BLOCK,
    WORDS,
    count,
    draw,
    merge,
    near,
    ones,
    widen,
)

_cached = entry_point(
    *(Path(__file__).with_name(f"{part}.py") for part in ("hand", "kernel", "vector"))
)

_ROWS = 16
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
            x, wide, y = (
                conics[e, X * LANES + i],
                conics[e, HX * LANES + i],
                conics[e, Y * LANES + i],
            )
            left = min(left, _clip(np.ceil(x - wide), width))
            right = max(right, _clip(np.floor(x + wide) + _ONE, width))
            top = min(top, _clip(np.ceil(y - high), height))
            bottom = max(bottom, _clip(np.floor(y + high) + _ONE, height))
    return left, top, right, bottom


@compiled
def _render(conics, i, box, origin, stride, tile, spans, lines):
    """The largest inverse depth of each pixel of the box, 0 = none.

    tile: flat, rows of `stride` pixels from row `top` and column `origin` of the image.
    spans: (2, rows), set to the first and last tile column drawn in each row.
    lines: (5 * _ROWS,) scratch.
    """
    left, top, right, bottom = box
    # Whole blocks, and one more that the last drawn block may reach into.
    begin = (left - origin) // BLOCK * BLOCK
    end = ((right - origin) // BLOCK + 2) * BLOCK
    for row in range(bottom - top):
        spans[0, row], spans[1, row] = stride, -1
        line = tile[row * stride + begin : row * stride + end]
        for column in range(end - begin):
            line[column] = _ZERO
    left_most, right_most = np.float32(left - origin), np.float32(right - 1 - origin)
    for e in range(conics.shape[0] - 1):
        conic = conics[e]
        high = conic[HY * LANES + i]
        if not high > _ZERO:
            continue
        x, y = conic[X * LANES + i] - np.float32(origin), conic[Y * LANES + i]
        shear, inverse = conic[XY * LANES + i], conic[IY * LANES + i]
        dx, du = conic[DX * LANES + i], conic[DU * LANES + i]
        u, slope_y, slope_x = conic[U * LANES + i], conic[UY * LANES + i], conic[UX * LANES + i]
        curve = du / dx
        first = max(_clip(np.ceil(y - high), bottom), top)
        rows = _clip(y + high + _ONE, bottom) - first
        for row in range(0, rows, _ROWS):
            lead = np.float32(first + row) - y
            for j in range(_ROWS):  # vectorised: what the rows have of their own
                dy = lead + np.float32(j)
                rest = max(_ONE - dy * dy * inverse, _ZERO)
                middle, half = x + shear * dy, math.sqrt(dx * rest)
                # Written so that NaN stays inside, too.
                low = np.ceil(middle - half)
                low = low if low > left_most else left_most
                low = low if low < right_most else right_most
                last = np.floor(middle + half)
                lines[j] = low
                lines[_ROWS + j] = last if last < right_most else right_most
                lines[2 * _ROWS + j] = low - middle
                lines[3 * _ROWS + j] = u + slope_y * dy
                lines[4 * _ROWS + j] = du * rest
            for j in range(min(_ROWS, rows - row)):
                low, high = int(lines[j]), int(lines[_ROWS + j])
                if low > high:
                    continue
                line = first - top + row + j
                spans[0, line] = min(spans[0, line], low)
                spans[1, line] = max(spans[1, line], high)
                at, t = line * stride + low, lines[2 * _ROWS + j]
                plane, peak = lines[3 * _ROWS + j], lines[4 * _ROWS + j]
                draw(tile, at, t, plane, slope_x, peak, curve)
                for _ in range(low + BLOCK, high + 1, BLOCK):
                    at += BLOCK
                    t += np.float32(BLOCK)
                    draw(tile, at, t, plane, slope_x, peak, curve)


@compiled
def _compare(tile, stride, spans, box, origin, images, model, above, residuals):
    """Counts of correct and false pixels of a tile, and the silhouette as bits.

    images: (3, H, >= W + BLOCK) low, high, occluder, such that nothing beyond W counts.
    model: (words + 2, R) zeros; the box's bits go to rows from `above` on, words from 1 on.
    residuals: (BLOCK,) sums to add to.
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
def _wanted(conics, i, model, words, first_row, rows, origin, hand, reach, wanted):
    """Bits of the hand's pixels outside of the silhouette and of the wrist's ellipsoid.

    hand: (words of a row + 1, H) bits of the evidence.  wanted: (words, rows + WORDS) is set.
    """
    shift = np.uint64(origin & 63)
    back = np.uint64(63) - shift
    for w in range(words):
        here = hand[(origin >> 6) + w, first_row : first_row + rows]
        after = hand[(origin >> 6) + w + 1, first_row : first_row + rows]
        covered, line = model[w + 1, reach : reach + rows], wanted[w]
        for r in range(rows):
            line[r] = ((here[r] >> shift) | (after[r] << np.uint64(1) << back)) & ~covered[r]
        for r in range(rows, rows + WORDS):
            line[r] = np.uint64(0)
    conic = conics[conics.shape[0] - 1]
    high, y = conic[HY * LANES + i], conic[Y * LANES + i] - np.float32(first_row)
    if high > _ZERO:
        x, shear = conic[X * LANES + i] - np.float32(origin), conic[XY * LANES + i]
        inverse, dx = conic[IY * LANES + i], conic[DX * LANES + i]
        for r in range(_clip(np.ceil(y - high), rows), _clip(y + high + _ONE, rows)):
            dy = np.float32(r) - y
            middle = x + shear * dy
            half = math.sqrt(dx * max(_ONE - dy * dy * inverse, _ZERO))
            first = _clip(np.ceil(middle - half), 64 * words)
            last = _clip(np.floor(middle + half) + _ONE, 64 * words) - 1
            for w in range(words):
                wanted[w, r] &= ~_run(first - 64 * w, last - 64 * w)


@compiled
def count_missed(model, words, rows, reach, steps, wanted, buffer):
    """How many wanted pixels lie within a disc of the silhouette: an exact Euclidean dilation.

    A disc is a horizontal run for each row offset. Taken from the longest run to the shortest, each
    step widens all that came before by the difference of the runs (Horner's scheme). WORDS rows
    at once, 64 columns to a word.

    model: (words + 2, R) bit rows by word with empty words around, the first at row `reach`.
    steps: (S, 2) pairs of: widen by a pixel to both sides or not, and the row offset to add or 0.
    wanted: (words, rows + WORDS).  buffer: (2 * (parts + 2) * WORDS,) scratch.
    """
    pitch, half = model.shape[1], buffer.shape[0] // 2
    missed = 0
    for first in range(0, rows, WORDS):
        some = np.uint64(0)
        for w in range(words):
            for r in range(first, first + WORDS):
                some |= wanted[w, r]
        if not some:
            continue
        for r in range(WORDS):
            for w in range(words + 2):
                buffer[w * WORDS + r] = model[w, reach + first + r]
                buffer[half + w * WORDS + r] = np.uint64(0)
        here, there = 0, half
        for step in range(steps.shape[0]):
            dy = steps[step, 1]
            for w in range(1, words + 1):
                # The empty word 0 of the model is what a step adds that only widens.
                middle = w * pitch + reach + first if dy else 0
                at = here + w * WORDS
                if steps[step, 0]:
                    widen(buffer, at, there + w * WORDS, model, middle - dy, middle + dy)
                else:
                    merge(buffer, at, model, middle - dy, middle + dy)
            if steps[step, 0]:
                here, there = there, here
        for w in range(words):
            missed += near(buffer, here + (w + 1) * WORDS, wanted, w * wanted.shape[1] + first)
    return missed


@_cached
def pack_evidence(low, high, occluder, hand):
    """Evidence as (3, H, W + padding) float32 images and (words + 1, H) bits of the hand."""
    height, width = hand.shape
    pitch = (width + 2 * BLOCK - 1) // BLOCK * BLOCK
    images = np.empty((3, height, pitch), np.float32)
    bits = np.zeros(((width + 63) // 64 + 1, height), np.uint64)
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
            bits[u >> 6, v] |= np.uint64(hand[v, u]) << np.uint64(u & 63)
    return images, bits


@_cached
def score_hands(
    states,
    k,
    images,
    hand,
    width,
    steps,
    slots,
    base,
    lengths,
    mirror,
    index,
    surface,
    counter,
    out,
):
    """Score tasks of LANES particles as long as `counter` has any; called from several threads.

    states: (N, 27).  k: fx, fy, cx, cy.  images, hand: of pack_evidence, for `width` columns.
    steps: of disc_steps.  slots .. surface: see NumbaScorer.
    counter: (1,) int64 tasks taken.  out: (4, N) correct, false, missed, residual.
    """
    height, reach, parts = images.shape[1], steps[:, 1].max(), hand.shape[0] - 1
    x = np.empty(27 * LANES, np.float32)
    sines, cosines = np.empty((2, 25 * LANES), np.float32)
    frames = np.empty((16, 12 * LANES), np.float32)
    valid = np.empty(LANES, np.uint8)
    conics = np.empty((index.shape[0], TERMS * LANES), np.float32)
    tile = np.empty(height * (64 * parts + 2 * BLOCK), np.float32)
    spans = np.empty((2, height), np.int64)
    lines = np.empty(5 * _ROWS, np.float32)
    residuals = np.empty(BLOCK, np.float32)
    model = np.empty((parts + 2, height + 2 * reach + WORDS), np.uint64)
    wanted = np.empty((parts, height + WORDS), np.uint64)
    buffer = np.empty(2 * (parts + 2) * WORDS, np.uint64)
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
            _render(conics, i, box, origin, stride, tile, spans, lines)
            residuals[:] = _ZERO
            model[: words + 2, : rows + 2 * reach + WORDS] = np.uint64(0)
            above = reach + top - first_row
            correct, false = _compare(
                tile, stride, spans, box, origin, images, model, above, residuals
            )
            out[0, first + i], out[1, first + i] = correct, false
            _wanted(conics, i, model, words, first_row, rows, origin, hand, reach, wanted)
            out[2, first + i] = count_missed(model, words, rows, reach, steps, wanted, buffer)
            out[3, first + i] = residuals.sum()
