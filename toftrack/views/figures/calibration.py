"""Pictures of a calibration: the corners that were found, and the depth error over distance."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from toftrack.views.figures import chart


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
    figure = chart.new_figure(720, 480)
    axes = figure.subplots()
    chart.label(axes, "true distance, m", "mean error of each board, mm")
    axes.axhline(0, color=chart.GREY, linewidth=1)
    for errors_m, name, colour in (
        (before_m, "before", chart.VERMILLION),
        (after_m, "after", chart.GREEN),
    ):
        axes.plot(distance_m, 1000 * errors_m, "o", color=colour, markersize=4, label=name)
    axes.legend()
    return chart.picture_of(figure)
