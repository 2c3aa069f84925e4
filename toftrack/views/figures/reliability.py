"""A reliability diagram: how often estimates are right that are so sure."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle

import numpy as np

from toftrack.views.figures import chart

_BINS = 10
_FEWEST = 10


def reliability_figure(groups: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Observed against said probability, BGR.

    groups: by name, the probabilities said (N,) and whether the estimates were right (N,).
    """
    figure = chart.new_figure(700, 460)
    axes = figure.subplots()
    chart.label(axes, "said (points: tenths of the range, mean of each)", "right")
    axes.plot((0, 1), (0, 1), color=chart.GREY, linewidth=1)
    for (name, (said, right)), colour in zip(groups.items(), cycle(chart.COLOURS), strict=False):
        axes.plot(*_binned(said, right), "o-", color=colour, label=f"{name} ({len(said)})")
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    figure.legend(loc="outside right upper", frameon=False)
    picture = chart.picture_of(figure)
    return chart.titled(picture, "Reliability of the confidence", "On the line is calibrated.")


def _binned(said: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean said and observed probability of the bins that hold enough frames."""
    index = np.minimum((said * _BINS).astype(int), _BINS - 1)
    rows = [index == number for number in range(_BINS)]
    rows = [row for row in rows if row.sum() >= _FEWEST]
    return np.array([said[r].mean() for r in rows]), np.array([right[r].mean() for r in rows])
