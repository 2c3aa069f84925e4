"""The pixels of the hand that a hypothesis leaves out, counted in rows of bits, 64 to a word."""

from __future__ import annotations

import numpy as np

from toftrack.compute.compiling import compiled
from toftrack.render.numba.hand import DX, HY, IY, LANES, XY, X, Y
from toftrack.render.numba.vector import (
    BLOCK,
    WORDS,
    down,
    larger,
    load,
    ones,
    ramp,
    root,
    shifted,
    smaller,
    splat,
    store,
    up,
    widened,
)

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_NONE, _ALL = np.uint64(0), ~np.uint64(0)


@compiled
def run(first, last):
    """A word with bits first .. last set, as far as they lie within it."""
    first, last = max(first, 0), min(last, 63)
    if last < first:
        return _NONE
    return (_ALL >> np.uint64(63 - last)) & (_ALL << np.uint64(first))


@compiled
def clipped(value, size):
    """A float as an integer in 0 .. size; 0 for NaN."""
    if not value > _ZERO:
        return 0
    return size if value >= size else int(value)


@compiled
def find_wanted(conics, i, model, words, first_row, rows, origin, hand, reach, wanted, places):
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
    begin, end = clipped(np.ceil(y - high), rows), clipped(y + high + _ONE, rows)
    left_most, right_most = splat(_ZERO), splat(np.float32(64 * words))
    for row in range(begin, end, BLOCK):
        dy = (np.float32(row) - y) + ramp()
        middle, half = x + shear * dy, root(dx * (_ONE - dy * dy * inverse))
        # In a row that just misses it, where the root is NaN, there is nothing to leave out.
        store(places, 0, smaller(larger(up(middle - half), left_most), right_most))
        store(places, BLOCK, smaller(larger(down(middle + half), left_most - _ONE), right_most))
        for j in range(min(BLOCK, end - row)):
            for w in range(words):
                wanted[w, row + j] &= ~run(places[j] - 64 * w, places[BLOCK + j] - 64 * w)


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
