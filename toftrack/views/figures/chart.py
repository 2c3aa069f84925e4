"""Plots as pictures: matplotlib's figures, without the global state of pyplot.

Pictures are (h, w, 3) uint8 BGR. matplotlib is loaded when the first figure is drawn.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from toftrack.errors import ToftrackError, module_of_extra
from toftrack.views.pictures import write_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, which colour-blind people can tell apart.
ORANGE, SKY, GREEN = "#e69f00", "#56b4e9", "#009e73"
BLUE, VERMILLION, PURPLE = "#0072b2", "#d55e00", "#cc79a7"
COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
GREY, SHADE = "#969696", "#fae2de"
_DPI = 100


def new_figure(width: int, height: int) -> Figure:
    """An empty figure of so many pixels; ToftrackError where matplotlib is missing."""
    module = module_of_extra("matplotlib.figure", "figures need matplotlib", "figures")
    figure = module.Figure((width / _DPI, height / _DPI), dpi=_DPI, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.1, h_pad=0.1)
    return figure


def picture_of(figure: Figure) -> np.ndarray:
    """The figure as a picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., 2::-1].copy()


def titled(picture: np.ndarray, title: str, note: str = "") -> np.ndarray:
    """The picture below a title and a note, which is broken into lines."""
    width = picture.shape[1]
    lines = textwrap.wrap(note, width // 7)
    height = 40 + 18 * len(lines)
    head = new_figure(width, height)
    head.text(14 / width, 1 - 10 / height, title, va="top", weight="bold", size=13)
    head.text(14 / width, 1 - 36 / height, "\n".join(lines), va="top")
    return np.vstack([picture_of(head), picture])


def write_figures(
    folder: Path, figures: Iterable[tuple[str, Callable[[], np.ndarray]]]
) -> list[Path]:
    """Draw figures and write them below their names, each of which comes with what draws it;
    returns the files.

    What cannot be drawn, as without matplotlib, or of a run whose pose space is of its user's own,
    is left out, and a note says so. Raises OSError.
    """
    written, missing = [], dict[str, list[str]]()
    for name, draw in figures:
        try:
            picture = draw()
        except ToftrackError as error:
            missing.setdefault(str(error), []).append(name)
            continue
        write_picture(folder / name, picture)
        written.append(folder / name)
    for why, names in missing.items():
        print(f"note: without {', '.join(names)}: {why}", file=sys.stderr)
    return written


def label(axes: Axes, x: str, y: str) -> None:
    """Names of both axes, and a pale grid."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)


def picture_above(axes: Axes, point: np.ndarray, grey: np.ndarray) -> None:
    """A (h, w) uint8 picture above a point of a plot; what is white in it is transparent."""
    from matplotlib.offsetbox import AnnotationBbox, OffsetImage

    shown = np.dstack([grey, grey, grey, np.where(grey < 255, 255, 0).astype(np.uint8)])
    above = {"xybox": (0, 48), "boxcoords": "offset points", "frameon": False}
    axes.add_artist(AnnotationBbox(OffsetImage(shown, dpi_cor=False), tuple(point), **above))


def round_log_ticks(axes: Axes, which: str) -> None:
    """Make axis `which`, x or y, logarithmic, with 1, 2 and 5 times powers of ten at its ticks."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def shade(
    axes: Axes,
    x: np.ndarray,
    where: Sequence[bool] | np.ndarray,
    colour: str,
    name: str,
    top: float = 0,
) -> None:
    """Colour the background from the height `top` (0 to 1) up, half way to the next of x, where
    `where` is true.
    """
    edges = np.concatenate([x[:1], (x[1:] + x[:-1]) / 2, x[-1:]])
    spans = [(edges[row], edges[row + 1] - edges[row]) for row in np.flatnonzero(where)]
    upright = axes.get_xaxis_transform()
    look = {"color": colour, "linewidth": 0, "antialiased": False, "zorder": 0.5}
    axes.broken_barh(spans, (top, 1 - top), transform=upright, label=name, **look)
