"""A reliability diagram: how often estimates are right that are so sure."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from toftrack.views.figures.chart import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    Axes,
    canvas,
    legend,
    titled,
    write,
)

_COLOURS = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY)
_BINS = 10
_FEWEST = 10


def reliability_figure(groups: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Observed against said probability, BGR.

    groups: by name, the probabilities said (N,) and whether the estimates were right (N,).
    """
    picture = canvas(470, 760)
    axes = Axes(70, 470, 40, 420, (0.0, 1.0), (0.0, 1.0))
    axes.draw(picture, "said", "right")
    ends = np.array([0.0, 1.0])
    axes.line(picture, ends, ends, GREY, 1)
    for row, (name, (said, right)) in enumerate(groups.items()):
        colour = _COLOURS[row % len(_COLOURS)]
        x, y = _binned(said, right)
        axes.line(picture, x, y, colour)
        for u, v in np.round(axes.place(x, y)).astype(int):
            cv2.circle(picture, (int(u), int(v)), 4, colour, -1, cv2.LINE_AA)
        legend(picture, ((f"{name} ({len(said)})", colour),), (500, 70 + 26 * row))
    write(picture, "points: tenths of the range, mean of each", (500, 420), size=0.4)
    return titled(picture, "Reliability of the confidence", "On the line is calibrated.")


def _binned(said: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean said and observed probability of the bins that hold enough frames."""
    index = np.minimum((said * _BINS).astype(int), _BINS - 1)
    rows = [index == number for number in range(_BINS)]
    rows = [row for row in rows if row.sum() >= _FEWEST]
    return np.array([said[r].mean() for r in rows]), np.array([right[r].mean() for r in rows])
