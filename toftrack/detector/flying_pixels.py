"""Flying pixels: readings that mix a surface with what is behind it, and lie on neither.

Every Time-of-Flight camera has them at outlines. The networks, which learned from images with few,
take them for fingers that are thicker or elsewhere.
"""

from __future__ import annotations

import numpy as np

from toftrack.compute.compiling import compiled, entry_point
from toftrack.compute.threads import run_shared

_ALIKE = np.int32(2)
"""So many of the eight readings about one are about as far away, or it is a flying pixel."""
_ROWS, _WORTH_A_THREAD = 64, 100_000
"""Rows that a thread looks at in one go; and pixels for which it pays to wake a second one."""


def without_flying_pixels(depth_m: np.ndarray, k: np.ndarray, widths: float) -> np.ndarray:
    """An image (H, W) float32, m, whose flying pixels have no reading, which is 0.

    k: (3, 3).  widths: readings are alike whose depths differ by less than so many pixels are wide
    there; 0 = all stay. Pixels grow with the distance, as does the noise of cameras.
    """
    if widths <= 0:
        return depth_m
    depth = np.ascontiguousarray(depth_m, np.float32)
    left, part = np.empty_like(depth), np.float32(widths / float(k[0, 0]))
    rows = iter(range(0, len(depth), _ROWS))

    def look() -> None:
        for first in rows:
            _sweep(depth, part, first, first + _ROWS, left)

    run_shared(look, depth.size // _WORTH_A_THREAD)
    return left


@entry_point
def _sweep(depth, part, first, end, left):
    """Rows `first` to `end` of an image, see above, into `left`.  part: of a depth.

    The outer columns stay. Without branches, so that pixels are looked at side by side.
    """
    height, width, nothing = depth.shape[0], depth.shape[1], np.float32(0)
    for v in range(first, min(end, height)):
        above, row, below = depth[max(v - 1, 0)], depth[v], depth[min(v + 1, height - 1)]
        inside_above, inside_below = np.int32(v > 0), np.int32(v < height - 1)
        left[v, 0], left[v, width - 1] = row[0], row[width - 1]
        for u in range(1, width - 1):
            z, near = row[u], part * row[u]
            beside = _alike(row[u - 1], z, near) + _alike(row[u + 1], z, near)
            over = _alike(above[u - 1], z, near) + _alike(above[u], z, near)
            over += _alike(above[u + 1], z, near)
            under = _alike(below[u - 1], z, near) + _alike(below[u], z, near)
            under += _alike(below[u + 1], z, near)
            count = beside + inside_above * over + inside_below * under
            left[v, u] = z if count >= _ALIKE else nothing


@compiled
def _alike(first, second, near):
    return np.int32(abs(first - second) < near)
