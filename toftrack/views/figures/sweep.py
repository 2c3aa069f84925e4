"""A sweep as a picture: the error of each setting against what a frame costs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

Point = tuple[str, float, float, float | None]
"""(settings, cost in ms, error, spread of the error over seeds or None)"""

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_TEXT, _GRID = (40, 40, 40), (225, 225, 225)
# Okabe and Ito's colours, which colour-blind people can tell apart; BGR.
_COLOURS = (
    (178, 114, 0),
    (0, 94, 213),
    (115, 158, 0),
    (167, 121, 204),
    (0, 159, 230),
    (233, 180, 86),
    (90, 90, 90),
)


def sweep_figure(points: Sequence[Point], label: str, width: int = 900) -> np.ndarray:
    """Numbered dots with bars of one deviation over seeds, a legend below; BGR.

    points: at least one.  label: of the error's axis, which starts at zero. The axis of the cost is
        logarithmic.
    """
    plot, line = 480, 26
    picture = np.full((plot + 70 + line * len(points), width, 3), 255, np.uint8)
    left, right, top, bottom = 80, width - 30, 40, plot
    costs = [max(cost, 1e-3) for _, cost, _, _ in points]
    low, high = min(costs) / 1.6, max(costs) * 1.6
    tallest = 1.1 * max(error + (spread or 0.0) for _, _, error, spread in points)
    tallest = tallest if tallest > 0 else 1.0

    def x_of(cost: float) -> int:
        return int(left + (right - left) * math.log(cost / low) / math.log(high / low))

    def y_of(error: float) -> int:
        return int(bottom - (bottom - top) * error / tallest)

    for tick in _ticks(tallest):
        cv2.line(picture, (left, y_of(tick)), (right, y_of(tick)), _GRID, 1)
        _write(picture, f"{tick:g}", (20, y_of(tick) + 5))
    for tick in _log_ticks(low, high):
        cv2.line(picture, (x_of(tick), top), (x_of(tick), bottom), _GRID, 1)
        _write(picture, f"{tick:g}", (x_of(tick) - 10, bottom + 22))
    _write(picture, label, (left, top - 14))
    _write(picture, "ms a frame", ((left + right) // 2 - 40, bottom + 46))

    for number, (settings, _, error, spread) in enumerate(points, 1):
        colour = _COLOURS[(number - 1) % len(_COLOURS)]
        u, v = x_of(costs[number - 1]), y_of(error)
        if spread is not None:
            ends = y_of(error + spread), y_of(max(error - spread, 0.0))
            cv2.line(picture, (u, ends[0]), (u, ends[1]), colour, 2, cv2.LINE_AA)
            for end in ends:
                cv2.line(picture, (u - 5, end), (u + 5, end), colour, 2, cv2.LINE_AA)
        cv2.circle(picture, (u, v), 6, colour, -1, cv2.LINE_AA)
        _write(picture, str(number), (u + 9, v - 7), colour)
        y = bottom + 62 + line * number - 8
        cv2.circle(picture, (left, y - 5), 6, colour, -1, cv2.LINE_AA)
        _write(picture, f"{number}  {settings}", (left + 14, y))
    return picture


def _write(
    picture: np.ndarray, text: str, place: tuple[int, int], colour: tuple[int, ...] = _TEXT
) -> None:
    cv2.putText(picture, text, place, _FONT, 0.5, colour, 1, cv2.LINE_AA)


def _ticks(highest: float) -> list[float]:
    """Round numbers from 0 up to the highest, at most eight."""
    step = 10.0 ** math.floor(math.log10(highest))
    step *= next(factor for factor in (0.2, 0.5, 1.0, 2.0) if highest / (step * factor) <= 7)
    return [step * n for n in range(int(highest / step) + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten between two values."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    every = [factor * 10.0**power for power in powers for factor in (1, 1.5, 2, 3, 5, 7)]
    return [tick for tick in every if low <= tick <= high]
