"""Pictures of a calibration: the corners that were found, and the depth error over distance."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

_FONT = cv2.FONT_HERSHEY_SIMPLEX
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
    left, right, top, bottom = 70, 700, 40, 430
    picture = np.full((480, 720, 3), 255, np.uint8)
    errors_mm = 1000 * np.concatenate([before_m, after_m, [0.0]])
    low, high = _limits(float(errors_mm.min()), float(errors_mm.max()))
    near, far = _limits(float(distance_m.min()), float(distance_m.max()))

    def place(x: float, y: float) -> tuple[int, int]:
        u = left + (x - near) / (far - near) * (right - left)
        v = bottom - (y - low) / (high - low) * (bottom - top)
        return round(u), round(v)

    for share in np.linspace(0, 1, 6):
        x, y = near + share * (far - near), low + share * (high - low)
        cv2.line(picture, place(x, low), place(x, high), (225, 225, 225), 1)
        cv2.line(picture, place(near, y), place(far, y), (225, 225, 225), 1)
        _write(picture, f"{x:.2f}", (place(x, low)[0] - 18, bottom + 18))
        _write(picture, f"{y:+.1f}", (12, place(near, y)[1] + 4))
    cv2.line(picture, place(near, 0), place(far, 0), (120, 120, 120), 1)
    for values, colour in ((before_m, _BEFORE), (after_m, _AFTER)):
        for x, y in zip(distance_m, 1000 * values, strict=True):
            cv2.circle(picture, place(float(x), float(y)), 3, colour, -1, cv2.LINE_AA)
    _write(picture, "mean error of each board, mm", (left, 24))
    _write(picture, "before", (420, 24), _BEFORE)
    _write(picture, "after", (500, 24), _AFTER)
    _write(picture, "true distance, m", (320, 468))
    return picture


def _limits(low: float, high: float) -> tuple[float, float]:
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin


def _write(
    picture: np.ndarray, text: str, at: tuple[int, int], colour: tuple[int, int, int] = (40, 40, 40)
) -> None:
    cv2.putText(picture, text, at, _FONT, 0.45, colour, 1, cv2.LINE_AA)
