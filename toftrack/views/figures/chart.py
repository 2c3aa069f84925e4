"""Plots with axes, drawn with OpenCV: a frame of data coordinates, ticks, lines, dots, legends.

Pictures are (h, w, 3) uint8 BGR. Text is OpenCV's, which knows ASCII only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

Colour = tuple[int, int, int]
"""BGR."""

# Okabe and Ito's colours, which colour-blind people can tell apart.
ORANGE, SKY, GREEN = (0, 159, 230), (233, 180, 86), (115, 158, 0)
BLUE, VERMILLION, PURPLE = (178, 114, 0), (0, 94, 213), (167, 121, 204)
TEXT, GREY, GRID, SHADE = (40, 40, 40), (150, 150, 150), (225, 225, 225), (222, 226, 250)

_FONT = cv2.FONT_HERSHEY_SIMPLEX


def canvas(height: int, width: int) -> np.ndarray:
    """A white picture."""
    return np.full((height, width, 3), 255, np.uint8)


def write(
    picture: np.ndarray,
    text: str,
    at: tuple[float, float],
    colour: Colour = TEXT,
    size: float = 0.5,
    align: str = "left",
) -> None:
    """Text whose base line starts, is centred or ends at (x, y): align left, middle or right."""
    width = text_width(text, size)
    x = at[0] - {"left": 0.0, "middle": width / 2, "right": float(width)}[align]
    thick = 2 if size >= 0.65 else 1
    place = (round(x), round(at[1]))
    cv2.putText(picture, text, place, _FONT, size, colour, thick, cv2.LINE_AA)


def text_width(text: str, size: float = 0.5) -> int:
    """Pixels that `write` needs."""
    return cv2.getTextSize(text, _FONT, size, 2 if size >= 0.65 else 1)[0][0]


def wrapped(text: str, width: int, size: float = 0.5) -> list[str]:
    """Lines of whole words, none wider than so many pixels unless a single word is."""
    lines: list[str] = []
    for word in text.split():
        extended = f"{lines[-1]} {word}" if lines else word
        if lines and text_width(extended, size) <= width:
            lines[-1] = extended
        else:
            lines.append(word)
    return lines


def titled(picture: np.ndarray, title: str, note: str = "") -> np.ndarray:
    """The picture below a title and a note in small print, which is broken into lines."""
    width = picture.shape[1]
    lines = wrapped(note, width - 32)
    head = canvas(44 + 22 * len(lines), width)
    write(head, title, (16, 30), size=0.7)
    for number, line in enumerate(lines):
        write(head, line, (16, 52 + 22 * number))
    return np.vstack([head, picture])


def legend(
    picture: np.ndarray,
    entries: Sequence[tuple[str, Colour]],
    at: tuple[int, int],
    mark: Callable[[np.ndarray, tuple[int, int], Colour], None] | None = None,
) -> None:
    """Marks and names in a row from (x, y) on; `mark` draws at its centre, else a dot."""
    x, y = at
    for name, colour in entries:
        if mark is None:
            cv2.circle(picture, (x, y - 5), 5, colour, -1, cv2.LINE_AA)
        else:
            mark(picture, (x, y - 5), colour)
        write(picture, name, (x + 13, y))
        x += 40 + text_width(name)


def box_mark(picture: np.ndarray, centre: tuple[int, int], colour: Colour) -> None:
    """A filled square with an outline, for `legend`."""
    (x, y), grey = centre, GREY
    cv2.rectangle(picture, (x - 7, y - 7), (x + 7, y + 7), colour, -1)
    cv2.rectangle(picture, (x - 7, y - 7), (x + 7, y + 7), grey, 1)


def ticks(low: float, high: float, most: int = 8) -> list[float]:
    """Round numbers within two values, at most so many."""
    span = max(high - low, 1e-9)
    step = 10.0 ** math.floor(math.log10(span))
    step *= next(f for f in (0.1, 0.2, 0.5, 1.0, 2.0) if span / (step * f) <= most - 1)
    first = math.ceil(low / step - 1e-9)
    return [step * n for n in range(first, math.floor(high / step + 1e-9) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten within two values."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    every = [factor * 10.0**power for power in powers for factor in (1, 2, 5)]
    return [tick for tick in every if low <= tick <= high]


@dataclass(frozen=True)
class Axes:
    """A rectangle of a picture with data coordinates.

    left, right, top, bottom: pixels.  x, y: the data's limits.  log_x, log_y: an axis that is
    logarithmic.
    """

    left: int
    right: int
    top: int
    bottom: int
    x: tuple[float, float]
    y: tuple[float, float]
    log_y: bool = False
    log_x: bool = False

    def place(self, x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
        """(..., 2) pixels, float64, of data; values beyond the limits lie on the edge."""
        x, y = np.clip(x, *self.x), np.clip(y, *self.y)
        across, up = _share(x, self.x, self.log_x), _share(y, self.y, self.log_y)
        u = self.left + across * (self.right - self.left)
        v = self.bottom - up * (self.bottom - self.top)
        return np.stack(np.broadcast_arrays(u, v), -1)

    def draw(self, picture: np.ndarray, x_label: str, y_label: str) -> None:
        """Grid, ticks and labels: the upright axis's above it, the other's below (empty: none)."""
        for tick in log_ticks(*self.y) if self.log_y else ticks(*self.y, most=7):
            v = round(float(self.place(self.x[0], tick)[1]))
            cv2.line(picture, (self.left, v), (self.right, v), GRID, 1)
            write(picture, f"{tick:g}", (self.left - 10, v + 5), align="right", size=0.45)
        for tick in log_ticks(*self.x) if self.log_x else ticks(*self.x):
            u = round(float(self.place(tick, self.y[0])[0]))
            cv2.line(picture, (u, self.top), (u, self.bottom), GRID, 1)
            if x_label:
                write(picture, f"{tick:g}", (u, self.bottom + 19), align="middle", size=0.45)
        cv2.rectangle(picture, (self.left, self.top), (self.right, self.bottom), GREY, 1)
        write(picture, y_label, (self.left, self.top - 10))
        if x_label:
            middle = (self.left + self.right) / 2
            write(picture, x_label, (middle, self.bottom + 42), align="middle")

    def line(
        self, picture: np.ndarray, x: np.ndarray, y: np.ndarray, colour: Colour, width: int = 2
    ) -> None:
        """A line through points, broken where y is not finite; lone points become dots."""
        finite = np.isfinite(y)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], finite.view(np.int8), [0]])))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            spots = np.round(self.place(x[begin:end], y[begin:end]) * 8).astype(np.int32)
            if end - begin == 1:
                cv2.circle(picture, spots[0], 8 * width, colour, -1, cv2.LINE_AA, 3)
            else:
                cv2.polylines(picture, [spots], False, colour, width, cv2.LINE_AA, 3)

    def shade(self, picture: np.ndarray, x: np.ndarray, where: np.ndarray, colour: Colour) -> None:
        """The background of the rows in which `where` is true, half way to their neighbours."""
        middles = (x[1:] + x[:-1]) / 2
        starts = np.concatenate([[self.x[0]], middles])
        ends = np.concatenate([middles, [self.x[1]]])
        for start, end in zip(starts[where], ends[where], strict=True):
            left, right = (round(float(self.place(edge, self.y[0])[0])) for edge in (start, end))
            cv2.rectangle(picture, (left, self.top), (right, self.bottom), colour, -1)


def _share(
    value: np.ndarray | float, limits: tuple[float, float], logarithmic: bool
) -> np.ndarray | float:
    """How far between two limits a value lies, 0 to 1."""
    low, high = limits
    if logarithmic:
        value, low, high = np.log(value), math.log(low), math.log(high)
    return (value - low) / (high - low)
