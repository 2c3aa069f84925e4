"""The fused CPU kernel: from a state of 27 numbers to four counts, one particle at a time.

Each ellipsoid is drawn into a tile that holds one hand, only over the exact span of its outline in
each row; then the tile is compared with the evidence, which leaves the silhouette as rows of bits,
64 to a word; around these, the hand's pixels that a hypothesis leaves out are counted.
"""

from __future__ import annotations

import math

import numpy as np

from toftrack.compute.compiling import compiled, entry_point, shared_entry_point, take
from toftrack.render.numba.hand import (
    BOTTOM,
    DU,
    DX,
    HY,
    IY,
    LANES,
    LEFT,
    RIGHT,
    TERMS,
    TOP,
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
    compare,
    down,
    draw,
    larger,
    load,
    ones,
    ramp,
    root,
    shifted,
    smaller,
    splat,
    store,
    total,
    up,
    where_above,
    widened,
)

_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)
_NONE, _ALL = np.uint64(0), ~np.uint64(0)
_LAST = 8
"""Particles of a task near the end."""
_LISTED = 256
"""How many blocks are listed before they are drawn."""
_FAR = np.float32(1e-30)
"""Inverse depth of what is farther than any surface, but nearer than what is not drawn."""
_BITS = 4
"""Of a column, that say where in its block it is."""
_IMAGES = 3
"""Of the evidence, by blocks: the band's middle, 1 / its half-width, the occluder."""


@compiled
def blocks(width):
    """Blocks of a row of evidence; the last block that is drawn may reach past the image's edge."""
    return (width + 2 * BLOCK - 1) >> _BITS


@compiled
def _zeros(size):
    """A flat array of float32 that begins where a line of the cache does."""
    numbers = np.zeros(size + BLOCK, np.float32)
    skip = (-numbers.ctypes.data >> 2) & (BLOCK - 1)
    return numbers[skip : skip + size]


@compiled
def _run(first, last):
    """A word with bits first .. last set, as far as they lie within it."""
    first, last = max(first, 0), min(last, 63)
    if last < first:
        return _NONE
    return (_ALL >> np.uint64(63 - last)) & (_ALL << np.uint64(first))


@compiled
def _clipped(value, size):
    """A float as an integer in 0 .. size; 0 for NaN."""
    if not value > _ZERO:
        return 0
    return size if value >= size else int(value)


@compiled
def _render(conics, i, box, origin, stride, tile, spans, lines, places):
    """The largest inverse depth of each pixel of the box, drawn into a tile of zeros.

    What each row of each ellipsoid has of its own is listed, several rows at once, then drawn in
    one loop, whose length does not depend on the ellipsoids', so that it is foreseen.

    tile: flat, rows of `stride` pixels from row `top` and column `origin` of the image.
    spans: flat; one half is set to the first, the other to the last tile column drawn in each row.
    lines: (5 * _LISTED,) float32, places: (_LISTED,) int32 scratch.
    """
    left, top, right, bottom = box
    lasts = spans.shape[0] // 2
    for row in range(0, bottom - top, BLOCK):
        store(spans, row, splat(np.float32(stride)))
        store(spans, lasts + row, splat(-_ONE))
    left_most, right_most = np.float32(left - origin), np.float32(right - 1 - origin)
    # The last block that is drawn may reach so far.
    utmost = right_most + np.float32(BLOCK - 1)
    listed = np.int64(0)  # no literal, for which numba compiles what it is passed to once more
    for e in range(conics.shape[0] - 1):
        conic = conics[e]
        high, dx = conic[HY * LANES + i], conic[DX * LANES + i]
        if not high > _ZERO:
            continue
        x, y = conic[X * LANES + i] - np.float32(origin), conic[Y * LANES + i]
        shear, inverse = conic[XY * LANES + i], conic[IY * LANES + i]
        du, u = conic[DU * LANES + i], conic[U * LANES + i]
        slope_y, slope = conic[UY * LANES + i], conic[UX * LANES + i]
        curve, widest = splat(du / dx), min(_TWO * math.sqrt(dx), right_most - left_most)
        first = max(_clipped(np.ceil(y - high), bottom), top)
        rows = _clipped(y + high + _ONE, bottom) - first
        for row in range(0, rows, BLOCK):
            dy = (np.float32(first + row) - y) + ramp()
            rest = _ONE - dy * dy * inverse
            middle, half = x + shear * dy, root(dx * rest)
            # NaN, as in a row beside the ellipsoid, stays inside, too.
            low = smaller(larger(up(middle - half), left_most), right_most)
            last = larger(down(middle + half), low)
            line = first - top + row
            before, after = load(spans, line), load(spans, lasts + line)
            # Rounding may let a pixel more be drawn.
            end = larger(smaller(last + _ONE, utmost), after)
            store(spans, line, where_above(rest, smaller(low, before), before))
            store(spans, lasts + line, where_above(rest, end, after))
            t, peak, last = low - middle, du * rest, smaller(last, right_most)
            plane = u + slope_y * dy + slope * t
            at = (np.float32(line) + ramp()) * np.float32(stride) + low
            for column in range(0, int(widest) + 1, BLOCK):
                beyond = np.float32(column)
                store(places, listed, at + beyond)
                store(lines, listed, t + beyond)
                store(lines, _LISTED + listed, plane + slope * beyond)
                there = where_above(last - low - beyond + _ONE, peak, splat(-_ONE))
                store(lines, 2 * _LISTED + listed, there)
                store(lines, 3 * _LISTED + listed, splat(slope))
                store(lines, 4 * _LISTED + listed, curve)
                listed += min(BLOCK, rows - row)
                if listed > _LISTED - BLOCK:
                    _draw(lines, places, listed, tile)
                    listed = np.int64(0)
    _draw(lines, places, listed, tile)


@compiled
def _draw(lines, places, listed, tile):
    """The rows that are listed: t, plane, peak, slope and curve of `draw`, and where it begins."""
    for j in range(listed):
        t, plane, peak = lines[j], lines[_LISTED + j], lines[2 * _LISTED + j]
        draw(tile, places[j], t, plane, peak, lines[3 * _LISTED + j], lines[4 * _LISTED + j])


@compiled
def _compare(tile, stride, spans, box, origin, images, width, model, above):
    """Counts of correct and false pixels and the residual of a tile, the silhouette as bits.

    The tile is left empty.
    images: of pack_evidence, for `width` columns.
    model: (words + 2, R) zeros; the box's bits go to rows from `above` on, words from 1 on.
    """
    left, top, right, bottom = box
    lasts, pitch = spans.shape[0] // 2, blocks(width)
    correct, false, residual = splat(_ZERO), splat(_ZERO), splat(_ZERO)
    for row in range(bottom - top):
        begin = (top + row) * pitch + (origin >> _BITS)
        for block in range(int(spans[row]) >> _BITS, (int(spans[lasts + row]) >> _BITS) + 1):
            correct, false, residual = compare(
                tile,
                row * stride + (block << _BITS),
                images,
                (begin + block) * (_IMAGES * BLOCK),
                model,
                # Four blocks to a word, and words of one column one after the other.
                (((block >> 2) + 1) * model.shape[1] + above + row << 2) + (block & 3),
                correct,
                false,
                residual,
            )
    if right == width:
        # A block may reach past the image's edge.
        word, inside = 1 + (right - 1 - origin) // 64, _run(0, (right - 1 - origin) % 64)
        for row in range(above, above + bottom - top):
            model[word, row] &= inside
            model[word + 1, row] = np.uint64(0)
    return total(correct), total(false), total(residual)


@compiled
def _find_wanted(conics, i, model, words, first_row, rows, origin, hand, reach, wanted, places):
    """Bits of the hand's pixels outside of the silhouette and of the wrist's ellipsoid.

    hand: (words of a row + 1, H + WORDS) bits of the evidence.  wanted: (words, rows + WORDS) is
    set; rows from `rows` on may hold pixels that are too far away to be missed.
    places: (2 * BLOCK,) int32 scratch.
    """
    shift, column = np.uint64(origin & 63), origin >> 6
    for w in range(words):
        for row in range(0, rows, WORDS):
            here = load(hand[column + w], first_row + row)
            after = load(hand[column + w + 1], first_row + row)
            bits = shifted(here, after, shift)
            store(wanted[w], row, bits ^ (bits & load(model[w + 1], reach + row)))
    conic = conics[conics.shape[0] - 1]
    high, y = conic[HY * LANES + i], conic[Y * LANES + i] - np.float32(first_row)
    if not high > _ZERO:
        return
    x, shear = conic[X * LANES + i] - np.float32(origin), conic[XY * LANES + i]
    inverse, dx = conic[IY * LANES + i], conic[DX * LANES + i]
    begin, end = _clipped(np.ceil(y - high), rows), _clipped(y + high + _ONE, rows)
    left_most, right_most = splat(_ZERO), splat(np.float32(64 * words))
    for row in range(begin, end, BLOCK):
        dy = (np.float32(row) - y) + ramp()
        middle, half = x + shear * dy, root(dx * (_ONE - dy * dy * inverse))
        # In a row that just misses it, where the root is NaN, there is nothing to leave out.
        store(places, 0, smaller(larger(up(middle - half), left_most), right_most))
        store(places, BLOCK, smaller(larger(down(middle + half), left_most - _ONE), right_most))
        for j in range(min(BLOCK, end - row)):
            for w in range(words):
                wanted[w, row + j] &= ~_run(places[j] - 64 * w, places[BLOCK + j] - 64 * w)


@compiled
def count_missed(model, words, rows, reach, steps, wanted, buffer):
    """How many wanted pixels lie within a disc of the silhouette: an exact Euclidean dilation.

    A disc is a horizontal run for each row offset. Taken from the longest run to the shortest, each
    step widens all that came before by the difference of the runs (Horner's scheme). WORDS rows
    at once, 64 columns to a word.

    model: (words + 2, R) bit rows by word with empty words around, the first at row `reach`.
    steps: (S, 2) pairs of: widen by a pixel to both sides or not, and the row offset to add or 0.
    wanted: (words, rows + WORDS).  buffer: (2, (parts + 2) * WORDS) scratch.
    """
    missed = 0
    for first in range(0, rows, WORDS):
        some = splat(_NONE)
        for w in range(words):
            some = some | load(wanted[w], first)
        if ones(some) > 0:
            middle = reach + first
            if words <= 2:
                missed += _near_two(model, words, middle, steps, wanted, first)
            else:
                missed += _near_many(model, words, middle, steps, wanted, first, buffer)
    return missed


@compiled
def _near_two(model, words, middle, steps, wanted, first):
    """As count_missed, of WORDS rows of one or two words, which stay in registers."""
    near, right, none = load(model[1], middle), load(model[2], middle), splat(_NONE)
    for step in range(steps.shape[0]):
        dy = steps[step, 1]
        if steps[step, 0]:
            near, right = widened(none, near, right), widened(near, right, none)
        if dy:
            near = near | load(model[1], middle - dy) | load(model[1], middle + dy)
            right = right | load(model[2], middle - dy) | load(model[2], middle + dy)
    missed = ones(near & load(wanted[0], first))
    if words == 2:
        missed += ones(right & load(wanted[1], first))
    return missed


@compiled
def _near_many(model, words, middle, steps, wanted, first, buffer):
    """As count_missed, of WORDS rows of any number of words."""
    for w in range(words + 2):
        store(buffer[0], w * WORDS, load(model[w], middle))
        store(buffer[1], w * WORDS, splat(_NONE))
    here = 0
    for step in range(steps.shape[0]):
        there = 1 - here if steps[step, 0] else here
        dy = steps[step, 1]
        for w in range(1, words + 1):
            near = load(buffer[here], w * WORDS)
            if steps[step, 0]:
                left, right = (
                    load(buffer[here], (w - 1) * WORDS),
                    load(buffer[here], (w + 1) * WORDS),
                )
                near = widened(left, near, right)
            if dy:
                near = near | load(model[w], middle - dy) | load(model[w], middle + dy)
            store(buffer[there], w * WORDS, near)
        here = there
    missed = 0
    for w in range(words):
        missed += ones(load(buffer[here], (w + 1) * WORDS) & load(wanted[w], first))
    return missed


@entry_point
def pack_evidence(low, high, occluder, hand):
    """Evidence as flat float32 blocks of three images and (words + 1, H + WORDS) bits of the hand.

    Each block of BLOCK columns of a row has the band's middle, 1 / its half-width and the occluder,
    such that nothing is correct where there is no band, and nothing counts beyond the last column.
    """
    height, width = hand.shape
    pitch = blocks(width)
    images = _zeros(height * pitch * _IMAGES * BLOCK)
    bits = np.zeros((((width + 63) >> 6) + 1, height + WORDS), np.uint64)
    half, part, never = np.float32(0.5), np.float32(1e-6), np.float32(np.inf)
    for v in range(height):
        for block in range(pitch):
            at, first = (v * pitch + block) * _IMAGES * BLOCK, block * BLOCK
            count = max(min(BLOCK, width - first), 0)  # the last block may lie outside
            for j in range(count):
                lowest, highest = low[v, first + j], high[v, first + j]
                # What is not drawn is 0, and must not be correct.
                least, banded = max(lowest, part * highest), highest > lowest
                images[at + j] = half * (highest + least) if banded else _ZERO
                images[at + BLOCK + j] = _TWO / (highest - least) if banded else never
                images[at + 2 * BLOCK + j] = max(occluder[v, first + j], _FAR)
            for j in range(count, BLOCK):
                images[at + BLOCK + j] = images[at + 2 * BLOCK + j] = never
        for word in range((width + 63) >> 6):
            found = np.uint64(0)
            for u in range(min(64, width - 64 * word)):
                found |= np.uint64(hand[v, 64 * word + u]) << np.uint64(u)
            bits[word, v] = found
    return images, bits


@shared_entry_point
def score_hands(states, frame, shape, counter, out):
    """Score particles as long as `counter` has any; called from several threads.

    A task is LANES of them, the last ones fewer, so that no thread waits long for another.

    states: (N, 27).  shape: see NumbaScorer.
    frame: k (fx, fy, cx, cy), images and hand of pack_evidence, the image's height and width, steps
        of disc_steps, and the farthest row of these.
    counter: (1,) int64 tasks taken.  out: (4, N) correct, false, missed, residual.
    """
    k, images, hand, height, width, steps, reach = frame
    slots, base, lengths, mirror, index, surface = shape
    parts = hand.shape[0] - 1
    whole = max(states.shape[0] // LANES - 2, 0)
    x = np.empty(27 * LANES, np.float32)
    frames = np.empty((16, 12 * LANES), np.float32)
    valid = np.empty(LANES, np.uint8)
    conics = np.empty((index.shape[0], TERMS * LANES), np.float32)
    boxes = np.empty(4 * LANES, np.float32)
    tile = np.empty(0, np.float32)
    spans = np.empty(2 * (height + BLOCK), np.float32)
    lines, places = np.empty(5 * _LISTED, np.float32), np.empty(_LISTED, np.int32)
    model = np.empty((parts + 3, height + 2 * (reach + WORDS)), np.uint64)
    wanted = np.empty((parts + 1, height + WORDS), np.uint64)
    buffer = np.empty((2, (parts + 3) * WORDS), np.uint64)
    while True:
        task, count = take(counter), LANES
        first = task * LANES
        if task >= whole:
            first, count = whole * LANES + (task - whole) * _LAST, _LAST
        if first >= states.shape[0]:
            break
        pose_hands(states, first, slots, base, lengths, mirror, x, frames, valid)
        project_hands(frames, index, surface, k, width, height, conics, boxes)
        for i in range(min(count, states.shape[0] - first)):
            for j in range(4):
                out[j, first + i] = _ZERO
            left, top = int(boxes[LEFT * LANES + i]), int(boxes[TOP * LANES + i])
            right, bottom = int(boxes[RIGHT * LANES + i]), int(boxes[BOTTOM * LANES + i])
            if not valid[i] or right <= left or bottom <= top:
                continue
            # Blocks of the tile are blocks of the evidence.
            origin, first_row = max(0, left - reach) & -BLOCK, max(0, top - reach)
            rows = min(height, bottom + reach) - first_row
            words = (min(width, right + reach) - origin + 63) >> 6
            stride = ((right - origin + 2 * BLOCK - 1) >> _BITS) << _BITS
            # What is listed may begin a row farther than it is drawn.
            if (bottom - top + 1) * stride > tile.shape[0]:
                tile = _zeros((bottom - top + BLOCK) * (stride + 2 * BLOCK))
            box = left, top, right, bottom
            _render(conics, i, box, origin, stride, tile, spans, lines, places)
            above = reach + top - first_row
            for w in range(words + 2):
                for row in range(0, rows + 2 * reach + WORDS, WORDS):
                    store(model[w], row, splat(np.uint64(0)))
            correct, false, residual = _compare(
                tile, stride, spans, box, origin, images, width, model, above
            )
            out[0, first + i], out[1, first + i], out[3, first + i] = correct, false, residual
            _find_wanted(
                conics, i, model, words, first_row, rows, origin, hand, reach, wanted, places
            )
            out[2, first + i] = count_missed(model, words, rows, reach, steps, wanted, buffer)
