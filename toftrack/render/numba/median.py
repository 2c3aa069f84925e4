"""The median filter of segmentation.reduce_image, compiled, and only where its result is read."""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from toftrack.compute.compiling import compiled, entry_point
from toftrack.render.numba.vector import BLOCK, FLOATS, store

SIDE = 5
"""Rows and columns of the window."""


def exchanges(count: int) -> list[tuple[int, int]]:
    """What to put in order to sort `count` values: Batcher's odd-even merge sort.

    Knuth, The Art of Computer Programming, volume 3, algorithm 5.2.2M.
    """
    found = []
    p = top = 1 << (count - 1).bit_length() - 1
    while p > 0:
        q, r, d = top, 0, p
        while True:
            found += [(i, i + d) for i in range(count - d) if i & p == r]
            if q == p:
                break
            d, q, r = q - p, q >> 1, p
        p >>= 1
    return found


@intrinsic
def _median(typingctx, lines, starts, column):
    """The medians of what stands in SIDE * SIDE places from `column` on, for BLOCK columns.

    starts: (SIDE * SIDE,) int64, where column 0 is in `lines`.
    What only sorts the other values is dropped by the compiler.
    """

    def codegen(context, builder, signature, args):
        lines, starts, column = args
        lines, starts = (
            context.make_array(kind)(context, builder, array).data
            for kind, array in zip(signature.args, (lines, starts), strict=False)
        )
        kind, word = ir.VectorType(ir.FloatType(), BLOCK), ir.IntType(64)
        values = []
        for j in range(SIDE * SIDE):
            start = builder.load(builder.gep(starts, [word(j)]))
            at = builder.gep(lines, [builder.add(start, column)])
            values.append(builder.load(builder.bitcast(at, kind.as_pointer()), align=4))
        for low, high in exchanges(len(values)):
            a, b = values[low], values[high]
            less = builder.fcmp_ordered("<", a, b)
            values[low], values[high] = builder.select(less, a, b), builder.select(less, b, a)
        return values[len(values) // 2]

    return FLOATS(lines, starts, types.intp), codegen


@compiled
def _take_every(source, start, factor, line, count):
    """source[start], source[start + factor] ..; beyond its ends, the first and last again."""
    last = source.shape[0] - 1
    begin = min(max((factor - 1 - start) // factor, 0), count)
    end = max(min((last - start) // factor + 1, count), begin)
    for j in range(begin):
        line[j] = source[0]
    for j in range(np.uint64(begin), np.uint64(end)):
        line[j] = source[np.uint64(j * np.uint64(factor) + np.uint64(start))]
    for j in range(end, count):
        line[j] = source[last]


@entry_point
def _thinned(image, factor, offset, out):
    """See `thinned`."""
    height, (rows, columns) = image.shape[0], out.shape
    pitch = (columns + 1 + BLOCK) // BLOCK * BLOCK + BLOCK
    # Of the last SIDE rows of the image: every `factor`-th pixel, from SIDE first ones on. What
    # begins a whole factor later is the same, but for the first.
    phases = min(SIDE, factor)
    lines = np.zeros(SIDE * phases * pitch, np.float32)
    held, starts = np.full(SIDE, -1), np.empty(SIDE * SIDE, np.int64)
    found = np.empty(pitch, np.float32)
    for row in range(rows):
        for j in range(SIDE):
            source = min(max(row * factor + offset + j - SIDE // 2, 0), height - 1)
            slot = source % SIDE
            for i in range(SIDE):
                starts[j * SIDE + i] = (slot * phases + i % phases) * pitch + i // phases
            if held[slot] == source:
                continue
            held[slot] = source
            for i in range(phases):
                line = lines[(slot * phases + i) * pitch : (slot * phases + i + 1) * pitch]
                _take_every(image[source], offset + i - SIDE // 2, factor, line, columns + 1)
        for column in range(0, columns, BLOCK):
            store(found, column, _median(lines, starts, column))
        for column in range(columns):
            out[row, column] = found[column]


def thinned(image: np.ndarray, factor: int, offset: int) -> np.ndarray:
    """Every `factor`-th pixel from `offset` on of an image filtered by the median of SIDE x SIDE.

    image: (H, W) float32 without NaN; at its edge, the last pixels are repeated.
    factor: 3 or more.
    The same as cv2.medianBlur(image, SIDE)[offset::factor, offset::factor], without the pixels
    between. On one thread, for meanwhile the networks have the others.
    """
    rows, columns = (len(range(offset, size, factor)) for size in image.shape)
    out = np.empty((rows, columns), np.float32)
    _thinned(image, factor, offset, out)
    return out
