"""How the back ends build an exact Euclidean disc dilation out of shifts of bit rows."""

from __future__ import annotations

import functools
import math

import numpy as np


def disc_square(radius_px: float, height: int, width: int) -> int:
    """The largest squared distance, in pixels, within a disc on an image.

    Discs of radii with the same square are the same, so that few differ as a hand moves.
    """
    radius = min(max(float(radius_px), 0.0), math.hypot(height, width))
    return math.floor(radius**2)


@functools.lru_cache(maxsize=256)
def disc_steps(square: int, height: int, width: int) -> np.ndarray:
    """How to build a disc from its longest row to its shortest; square: see disc_square.

    A disc is a horizontal run for each row offset dy. Each step widens all that came before by a
    pixel to both sides or not (Horner's scheme), and adds the silhouette at row offsets -+ dy.

    Returns (S, 2) int64: a pixel wider or not, and the row offset to add or 0; read only.
    """
    offsets = range(min(math.isqrt(square), height) + 1)
    halves = [min(math.isqrt(square - dy**2), width) for dy in offsets] + [0]
    steps = [(0, 0)]
    for dy in range(1, len(halves)):
        grow = halves[dy - 1] - halves[dy]
        steps += [(1, 0)] * max(grow - 1, 0)
        steps.append((min(grow, 1), dy if dy < len(halves) - 1 else 0))
    return np.array(steps, np.int64)
