"""Flying pixels: readings that mix a surface with what is behind it, and lie on neither.

Every Time-of-Flight camera has them at outlines. The networks, which learned from images with few,
take them for fingers that are thicker or elsewhere.
"""

from __future__ import annotations

import numpy as np

from toftrack.compute.compiling import compiled, entry_point

_FAR = np.float32(np.inf)
"""The depth beyond the image's rows, which no reading is near to; and a gap larger than any."""


def without_flying_pixels(depth_m: np.ndarray, k: np.ndarray, widths: float) -> np.ndarray:
    """An image (H, W) float32, m, whose flying pixels have no reading, which is 0.

    A reading stays if two of the eight about it are as far away, or it is in the outermost columns.

    k: (3, 3).  widths: readings are alike whose depths differ by less than so many pixels are wide
    there; 0 = all stay. Pixels grow with the distance, as does the noise of cameras.
    """
    if widths <= 0:
        return depth_m
    depth = np.ascontiguousarray(depth_m, np.float32)
    left = np.empty_like(depth)
    _sweep(depth, np.float32(widths / float(k[0, 0])), left)
    return left


@entry_point
def _sweep(depth, part, left):
    """An image, see above, into `left`.  part: of a depth.

    The outer columns stay. By the second least of eight gaps, which LLVM computes for many pixels
    at once; counting takes twice as long.
    """
    height, width, nothing = depth.shape[0], depth.shape[1], np.float32(0)
    beyond = np.full(width, _FAR, np.float32)
    for v in range(height):
        row = depth[v]
        above = depth[v - 1] if v > 0 else beyond
        below = depth[v + 1] if v < height - 1 else beyond
        left[v, 0], left[v, width - 1] = row[0], row[width - 1]
        for u in range(1, width - 1):
            z = row[u]
            two = _least_two(abs(row[u - 1] - z), _FAR, abs(row[u + 1] - z))
            two = _least_two(*two, abs(above[u - 1] - z))
            two = _least_two(*two, abs(above[u] - z))
            two = _least_two(*two, abs(above[u + 1] - z))
            two = _least_two(*two, abs(below[u - 1] - z))
            two = _least_two(*two, abs(below[u] - z))
            two = _least_two(*two, abs(below[u + 1] - z))
            left[v, u] = z if two[1] < part * z else nothing


@compiled
def _least_two(least, second, gap):
    """The least two of two gaps in order and a third one."""
    return min(least, gap), min(second, max(least, gap))
