"""A sweep as a picture: the error of each setting against what a frame costs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from toftrack.views.figures import chart

Point = tuple[str, float, float, float | None]
"""(settings, cost in ms, error, spread of the error over seeds or None)"""


def sweep_figure(points: Sequence[Point], label: str) -> np.ndarray:
    """Numbered dots with bars of one deviation over seeds, a legend below; BGR.

    points: at least one.  label: of the error's axis, which starts at zero. The axis of the cost is
        logarithmic.
    """
    figure = chart.new_figure(900, 500 + 22 * len(points))
    axes = figure.subplots()
    chart.label(axes, "ms a frame", label)
    for number, (settings, cost_ms, error, spread) in enumerate(points, 1):
        colour, at = chart.COLOURS[(number - 1) % len(chart.COLOURS)], (max(cost_ms, 1e-3), error)
        axes.errorbar(*at, spread, fmt="o", color=colour, capsize=5, label=f"{number}  {settings}")
        axes.annotate(str(number), at, (7, 5), textcoords="offset points", color=colour)
    chart.round_log_ticks(axes, "x")
    axes.margins(0.15, 0.1)
    axes.set_ylim(bottom=0)
    figure.legend(loc="outside lower left", frameon=False)
    return chart.picture_of(figure)
