"""Pictures of a calibration: the corners that were found, and the depth error over distance."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from toftrack.views.figures import chart
from toftrack.views.figures.chart import Axes

_BEFORE, _AFTER = (60, 60, 220), (60, 160, 40)  # BGR


def corner_sheet(
    images: Sequence[tuple[np.ndarray, np.ndarray]], board: tuple[int, int], columns: int = 4
) -> np.ndarray:
    """(H, W, 3) uint8 BGR: amplitude images with their corners drawn in, in rows.

    Args:
        images: of each the (H, W) amplitude and the (columns * rows, 2) corners in pixels.
        board: columns, rows of inner corners.
        columns: pictures in a row.
    """
    scale, tiles = 2, []
    for amplitude, corners in images:
        root = np.sqrt(amplitude.astype(np.float32))
        grey = (255 * root / max(float(root.max()), 1.0)).astype(np.uint8)
        shown = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        tile = cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR)
        places = ((corners + 0.5) * scale - 0.5).astype(np.float32).reshape(-1, 1, 2)
        cv2.drawChessboardCorners(tile, board, places, True)
        tiles.append(tile)
    while len(tiles) % columns:
        tiles.append(np.zeros_like(tiles[0]))
    rows = [np.hstack(tiles[at : at + columns]) for at in range(0, len(tiles), columns)]
    return np.vstack(rows)


def error_plot(distance_m: np.ndarray, before_m: np.ndarray, after_m: np.ndarray) -> np.ndarray:
    """(480, 720, 3) uint8 BGR: the boards' mean depth errors over their distance.

    Args:
        distance_m: (V,) true distances.
        before_m: (V,) errors of the measured distance.
        after_m: (V,) errors of the corrected distance.
    """
    picture = chart.canvas(480, 720)
    errors_mm = 1000 * np.concatenate([before_m, after_m, [0.0]])
    across = _limits(float(distance_m.min()), float(distance_m.max()))
    up = _limits(float(errors_mm.min()), float(errors_mm.max()))
    axes = Axes(70, 700, 40, 430, across, up)
    axes.draw(picture, "true distance, m", "mean error of each board, mm")
    axes.line(picture, np.array(across), np.zeros(2), chart.GREY, 1)
    for values, colour in ((before_m, _BEFORE), (after_m, _AFTER)):
        for spot in np.round(axes.place(distance_m, 1000 * values)).astype(int).tolist():
            cv2.circle(picture, spot, 3, colour, -1, cv2.LINE_AA)
    chart.legend(picture, [("before", _BEFORE), ("after", _AFTER)], (420, 30))
    return picture


def _limits(low: float, high: float) -> tuple[float, float]:
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin
