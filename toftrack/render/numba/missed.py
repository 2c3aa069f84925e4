"""The pixels of the hand that a hypothesis leaves out, counted in rows of bits."""

from __future__ import annotations

import numpy as np

from toftrack.compute.compiling import compiled
from toftrack.render.numba.hand import DX, HY, IY, LANES, XY, X, Y
from toftrack.render.numba.vector import BLOCK, down, larger, ramp, root, smaller, splat, store, up
from toftrack.render.numba.words import (
    WORDS,
    any_bit,
    load_rows,
    no_rows,
    ones,
    shifted,
    store_rows,
    widened,
    without,
)

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_ALL = ~np.uint64(0)


@compiled
def run(first, last):
    """A word with bits first .. last set, as far as they lie within it."""
    first, last = max(first, 0), min(last, 63)
    if last < first:
        return np.uint64(0)
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
            here = load_rows(hand, column + w, first_row + row)
            after = load_rows(hand, column + w + 1, first_row + row)
            covered = load_rows(model, w + 1, reach + row)
            store_rows(wanted, w, row, without(shifted(here, after, shift), covered))
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
        some = no_rows()
        for w in range(words):
            some = some | load_rows(wanted, w, first)
        if any_bit(some):
            middle = reach + first
            if words == 1:
                missed += _near_one(model, middle, steps, load_rows(wanted, 0, first))
            elif words == 2:
                left, right = load_rows(wanted, 0, first), load_rows(wanted, 1, first)
                missed += _near_two(model, middle, steps, left, right)
            else:
                missed += _near_many(model, words, middle, steps, wanted, first, buffer)
    return missed


@compiled
def _near_one(model, middle, steps, wanted):
    """As count_missed, of WORDS rows of a single word."""
    near, none = load_rows(model, 1, middle), no_rows()
    for step in range(steps.shape[0]):
        dy = steps[step, 1]
        if steps[step, 0]:
            near = widened(none, near, none)
        if dy:
            near = near | load_rows(model, 1, middle - dy) | load_rows(model, 1, middle + dy)
    return ones(near & wanted)


@compiled
def _near_two(model, middle, steps, wanted, wanted_right):
    """As count_missed, of WORDS rows of two words, which stay in registers."""
    near, right, none = load_rows(model, 1, middle), load_rows(model, 2, middle), no_rows()
    for step in range(steps.shape[0]):
        dy = steps[step, 1]
        if steps[step, 0]:
            near, right = widened(none, near, right), widened(near, right, none)
        if dy:
            near = near | load_rows(model, 1, middle - dy) | load_rows(model, 1, middle + dy)
            right = right | load_rows(model, 2, middle - dy) | load_rows(model, 2, middle + dy)
    return ones(near & wanted) + ones(right & wanted_right)


@compiled
def _near_many(model, words, middle, steps, wanted, first, buffer):
    """As count_missed, of WORDS rows of any number of words."""
    for w in range(words + 2):
        store_rows(buffer, 0, w * WORDS, load_rows(model, w, middle))
        store_rows(buffer, 1, w * WORDS, no_rows())
    here = 0
    for step in range(steps.shape[0]):
        there = 1 - here if steps[step, 0] else here
        dy = steps[step, 1]
        for w in range(1, words + 1):
            near = load_rows(buffer, here, w * WORDS)
            if steps[step, 0]:
                left = load_rows(buffer, here, (w - 1) * WORDS)
                near = widened(left, near, load_rows(buffer, here, (w + 1) * WORDS))
            if dy:
                near = near | load_rows(model, w, middle - dy) | load_rows(model, w, middle + dy)
            store_rows(buffer, there, w * WORDS, near)
        here = there
    missed = 0
    for w in range(words):
        near = load_rows(buffer, here, (w + 1) * WORDS)
        missed += ones(near & load_rows(wanted, w, first))
    return missed
