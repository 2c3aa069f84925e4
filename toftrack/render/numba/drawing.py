"""Range images of one hand in compiled code."""

from __future__ import annotations

import numpy as np

from toftrack.compute.compiling import entry_point


@entry_point
def draw(
    linear: np.ndarray,
    quadratic: np.ndarray,
    boxes: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    image: np.ndarray,
) -> None:
    """Z of the nearest of E ellipsoids, into an image of zeros.

    linear: (E, 3) and quadratic: (E, 3, 3) of their inverse depths, see closed_form.
    boxes: (E, 4) left, right, top, bottom.  x, y: slopes of the columns' and rows' rays.
    """
    height, width = image.shape
    for e in range(len(boxes)):
        left, right, top, bottom = boxes[e]
        if right <= left or bottom <= top:
            continue
        line, q = linear[e], quadratic[e]
        for row in range(max(0, top - 1), min(height, bottom + 1)):
            py = y[row]
            for column in range(max(0, left - 1), min(width, right + 1)):
                px = x[column]
                square = (q[0, 0] * px + 2 * q[0, 2]) * px + (q[1, 1] * py + 2 * q[1, 2]) * py
                square += q[2, 2] + 2 * q[0, 1] * px * py
                if square >= 0:
                    u = line[0] * px + line[1] * py + line[2] + np.sqrt(square)
                    image[row, column] = max(image[row, column], u)
    for row in range(height):
        for column in range(width):
            if image[row, column] > 0:
                image[row, column] = 1 / image[row, column]
