"""A sweep as a picture: the error of each setting against what a frame costs."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from toftrack.views.figures import chart
from toftrack.views.figures.chart import Axes

Point = tuple[str, float, float, float | None]
"""(settings, cost in ms, error, spread of the error over seeds or None)"""

_COLOURS = (
    *(chart.BLUE, chart.VERMILLION, chart.GREEN, chart.PURPLE, chart.ORANGE, chart.SKY),
    (90, 90, 90),
)


def sweep_figure(points: Sequence[Point], label: str, width: int = 900) -> np.ndarray:
    """Numbered dots with bars of one deviation over seeds, a legend below; BGR.

    points: at least one.  label: of the error's axis, which starts at zero. The axis of the cost is
        logarithmic.
    """
    plot, line = 480, 26
    picture = chart.canvas(plot + 70 + line * len(points), width)
    costs = [max(cost, 1e-3) for _, cost, _, _ in points]
    tallest = 1.1 * max(error + (spread or 0.0) for _, _, error, spread in points) or 1.0
    limits = min(costs) / 1.6, max(costs) * 1.6
    axes = Axes(80, width - 30, 40, plot, limits, (0.0, tallest), log_x=True)
    axes.draw(picture, "ms a frame", label)
    for number, (settings, _, error, spread) in enumerate(points, 1):
        colour, cost = _COLOURS[(number - 1) % len(_COLOURS)], costs[number - 1]
        u, v = np.round(axes.place(cost, error)).astype(int).tolist()
        if spread is not None:
            ends = [round(float(axes.place(cost, error + s)[1])) for s in (spread, -spread)]
            cv2.line(picture, (u, ends[0]), (u, ends[1]), colour, 2, cv2.LINE_AA)
            for end in ends:
                cv2.line(picture, (u - 5, end), (u + 5, end), colour, 2, cv2.LINE_AA)
        cv2.circle(picture, (u, v), 6, colour, -1, cv2.LINE_AA)
        chart.write(picture, str(number), (u + 9, v - 7), colour)
        y = plot + 62 + line * number - 8
        chart.legend(picture, [(f"{number}  {settings}", colour)], (axes.left, y))
    return picture
