"""The median filter of segmentation.reduce_image, compiled, and only where its result is read."""

from __future__ import annotations

import numpy as np

from toftrack.compute.compiling import entry_point

_SIDE = 5
"""Rows and columns of the window."""


def _exchanges(count: int) -> np.ndarray:
    """(E, 2) pairs to put in order one after another, so that the median of `count` values stands
    in the middle: what of Batcher's odd-even merge sort leads there (Knuth, The Art of Computer
    Programming, volume 3, algorithm 5.2.2M).
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
    needed, kept = {count // 2}, []
    for pair in reversed(found):
        if needed & set(pair):
            needed |= set(pair)
            kept.append(pair)
    return np.array(kept[::-1])


_EXCHANGES = _exchanges(_SIDE * _SIDE)


@entry_point
def _thinned(image, factor, offset, exchanges, out):
    """See `thinned`; image, out: of int32.

    A row at a time, so that the exchanges are vectorised over its columns.
    """
    columns, half = out.shape[1], _SIDE // 2
    values = np.empty((_SIDE * _SIDE, columns), np.int32)
    where = np.empty((_SIDE, columns), np.uint64)
    for place in range(_SIDE):
        for column in range(columns):
            at = column * factor + offset + place - half
            where[place, column] = min(max(at, 0), image.shape[1] - 1)
    for row in range(len(out)):
        for place in range(_SIDE * _SIDE):
            at = row * factor + offset + place // _SIDE - half
            source = image[min(max(at, 0), len(image) - 1)]
            line, read = values[place], where[place % _SIDE]
            for column in range(columns):
                line[column] = source[read[column]]
        for pair in range(len(exchanges)):
            low, high = values[exchanges[pair, 0]], values[exchanges[pair, 1]]
            for column in range(columns):
                a, b = low[column], high[column]
                low[column], high[column] = min(a, b), max(a, b)
        for column in range(columns):
            out[row, column] = values[_SIDE * _SIDE // 2, column]


def thinned(image: np.ndarray, factor: int, offset: int) -> np.ndarray:
    """Every `factor`-th pixel from `offset` on of an image filtered by the median of 5 x 5.

    image: (H, W) float32, none negative or NaN; at its edge, the last pixels are repeated. The same
    as cv2.medianBlur(image, 5)[offset::factor, offset::factor], without the pixels between. On one
    thread, for meanwhile the networks have the others.
    """
    rows, columns = (len(range(offset, size, factor)) for size in image.shape)
    out = np.empty((rows, columns), np.float32)
    # As whole numbers they are in the same order, and exchanged six times as fast by AVX2, which
    # has a smaller one of two floats only with a branch or a slow store.
    _thinned(image.view(np.int32), factor, offset, _EXCHANGES, out.view(np.int32))
    return out
