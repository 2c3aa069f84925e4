"""Figures of a finished run, as the paper has them (figs. 3, 5, 6), and its course over time.

Pictures are (h, w, 3) uint8 BGR.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from toftrack.pose_space.base import PoseSpace
from toftrack.render.segmentation import Observation
from toftrack.views.classified import CLASS_RGB, CLASSES, Classified
from toftrack.views.figures import chart
from toftrack.views.figures.chart import Axes
from toftrack.views.figures.poses import BASIC_BGR, nearest_gestures
from toftrack.views.overlay import film_tile, filmstrip, range_grey

_MARGIN_PX = 8
_GAP = 16
_SURE = chart.PURPLE


def measurement_figure(observation: Observation, pixels: Classified, title: str) -> np.ndarray:
    """How one hypothesis is measured: input, range image, neighbourhood, classified (fig. 3).

    The observation's grid, cut to where something is counted.
    """
    hand, depth = observation.hand.cpu().numpy(), observation.depth_m.cpu().numpy()
    counted = pixels.neighbourhood | (pixels.range_m > 0)
    shown = counted if counted.any() else hand
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    here = np.s_[:, :]
    if len(rows):
        here = np.s_[
            max(0, rows[0] - _MARGIN_PX) : rows[-1] + 1 + _MARGIN_PX,
            max(0, columns[0] - _MARGIN_PX) : columns[-1] + 1 + _MARGIN_PX,
        ]
    # In one go, so that the same grey is the same distance in both.
    greys = np.hsplit(range_grey(np.hstack([np.where(hand, depth, 0), pixels.range_m])), 2)
    near = np.full_like(greys[0], 255)
    near[pixels.neighbourhood], near[pixels.range_m > 0] = 190, 60
    colours = np.array(CLASS_RGB, np.uint8)[pixels.labels()][..., ::-1]
    panels = []
    for picture, caption in (
        (greys[0], "input, segmented"),
        (greys[1], "range image of the estimate"),
        (near, "its neighbourhood (grey)"),
        (colours, "classified pixels"),
    ):
        part = picture[here]
        scale = 290 / part.shape[1]
        size = (290, max(1, round(part.shape[0] * scale)))
        part = cv2.resize(np.ascontiguousarray(part), size, interpolation=cv2.INTER_NEAREST)
        part = part if part.ndim == 3 else cv2.cvtColor(part, cv2.COLOR_GRAY2BGR)
        cv2.rectangle(part, (0, 0), (size[0] - 1, size[1] - 1), chart.GREY, 1)
        head = chart.canvas(30, size[0])
        chart.write(head, caption, (2, 20))
        panels += [chart.canvas(size[1] + 30, _GAP), np.vstack([head, part])]
    body = np.hstack([*panels, chart.canvas(panels[0].shape[0], _GAP)])
    counts = (int(image.sum()) for image in (pixels.correct, pixels.false, pixels.missed))
    names = [f"{count} {name}" for count, name in zip(counts, CLASSES[2:], strict=True)]
    foot = chart.canvas(46, body.shape[1])
    entries = [(n, rgb[::-1]) for n, rgb in zip(names, CLASS_RGB[2:], strict=True)]
    chart.legend(foot, [*entries, (CLASSES[1], CLASS_RGB[1])], (30, 28), chart.box_mark)
    note = "Nearer is darker, in both range images alike. Pixels as the likelihood counts them."
    return chart.titled(np.vstack([body, foot]), title, note)


def filmstrip_figure(panels: Sequence[np.ndarray], title: str) -> np.ndarray:
    """Frames with the skeleton, below each the model's range image (fig. 5); panels of the
    overlay.
    """
    strip = filmstrip([film_tile(panel) for panel in panels])
    note = (
        "Above: the camera's image with the estimated skeleton. Below: the range image of the "
        "estimate, nearer is darker. Red: lost."
    )
    return chart.titled(strip, title, note)


def lost_figure(
    panels: Sequence[np.ndarray],
    rows: Sequence[int],
    time_s: np.ndarray,
    frames: np.ndarray,
    score: np.ndarray,
    lost: np.ndarray,
    title: str,
    confidence: np.ndarray | None = None,
) -> np.ndarray:
    """Frames that went wrong above the course of the score, in which they are marked (fig. 6).

    panels: of the overlay, one for each of `rows`.  The others: (T,), confidence as for
    course_figure.
    """
    strip = filmstrip([film_tile(panel) for panel in panels])
    width = max(strip.shape[1], 1000)
    strip = cv2.copyMakeBorder(
        strip, 0, 0, 0, width - strip.shape[1], cv2.BORDER_CONSTANT, value=(255, 255, 255)
    )
    plot = chart.canvas(330, width)
    axes = Axes(70, width - 30, 60, 250, _span(time_s), (0.0, 1.0))
    axes.shade(plot, time_s, lost, chart.SHADE)
    axes.draw(plot, "time, s", "score")
    axes.line(plot, time_s, score, chart.BLUE)
    for row in rows:
        x, y = np.round(axes.place(time_s[row], score[row])).astype(int)
        cv2.circle(plot, (x, y), 6, chart.VERMILLION, -1, cv2.LINE_AA)
        cv2.line(plot, (x, axes.top), (x, axes.top - 6), chart.VERMILLION, 2)
    _write_frames(plot, axes, time_s[list(rows)], frames[list(rows)])
    chart.legend(plot, [("frames shown above", chart.VERMILLION)], (84, 318))
    chart.legend(plot, [("lost", chart.SHADE)], (290, 318), chart.box_mark)
    if confidence is not None and np.isfinite(confidence).any():
        axes.line(plot, time_s, confidence, _SURE)
        chart.legend(plot, [("score", chart.BLUE), ("confidence", _SURE)], (400, 318))
    note = "Above: the camera's image with the estimated skeleton, and the estimate's range image."
    return chart.titled(np.vstack([strip, plot]), title, note)


def _write_frames(picture: np.ndarray, axes: Axes, time_s: np.ndarray, frames: np.ndarray) -> None:
    """Frame numbers above the axes of the score; those that would overlap are left out."""
    y, size = axes.top - 10, 0.45
    chart.write(picture, "frame", (axes.right, y), align="right")
    end: float = axes.left + chart.text_width("score") + 10
    last = axes.right - chart.text_width("frame") - 10
    for time, frame in sorted(zip(time_s.tolist(), frames.tolist(), strict=True)):
        x, half = float(axes.place(time, axes.y[0])[0]), chart.text_width(f"{frame}", size) / 2
        if x - half > end and x + half < last:
            chart.write(picture, f"{frame}", (x, y), align="middle", size=size)
            end = x + half + 8


def course_figure(
    time_s: np.ndarray,
    frames: np.ndarray,
    score: np.ndarray,
    lost: np.ndarray,
    title: str,
    error_mm: np.ndarray | None = None,
    absent: np.ndarray | None = None,
    confidence: np.ndarray | None = None,
) -> np.ndarray:
    """Error, score and confidence over time, lost frames shaded.

    Args:
        time_s, frames, score, lost: (T,).
        error_mm: (T, 21) against the truth, NaN where there is none; None draws the score alone.
        absent: (T,) the truth says that there is no hand to track, or not one of the known poses.
        confidence: (T,) that every joint is within 40 mm, NaN where nothing says; or None.
    """
    width, above = 1100, 0 if error_mm is None else 330
    picture = chart.canvas(above + 350, width)
    span = _span(time_s)
    if error_mm is not None:
        mean, largest = error_mm.mean(1), error_mm.max(1)
        axes = Axes(80, width - 30, 60, 300, span, _error_limits(mean, largest), log_y=True)
        axes.shade(picture, time_s, lost, chart.SHADE)
        axes.draw(picture, "", "joint error, mm (logarithmic)")
        axes.line(picture, time_s, largest, chart.ORANGE)
        axes.line(picture, time_s, mean, chart.BLUE)
        entries = [("mean of the joints", chart.BLUE), ("largest of a joint", chart.ORANGE)]
        chart.legend(picture, entries, (420, 50))
    axes = Axes(80, width - 30, above + 60, above + 250, span, (0.0, 1.0))
    axes.shade(picture, time_s, lost, chart.SHADE)
    axes.draw(picture, "time, s", "score")
    axes.line(picture, time_s, score, chart.GREEN)
    numbers = np.unique(np.linspace(0, len(frames) - 1, 11).round().astype(int))
    _write_frames(picture, axes, time_s[numbers], frames[numbers])
    entries = [("lost, says the tracker", chart.SHADE)]
    if absent is not None:
        entries.append(("no hand of the known poses, says the truth", chart.GREY))
        bar = Axes(axes.left, axes.right, axes.top, axes.top + 7, axes.x, axes.y)
        bar.shade(picture, time_s, absent, chart.GREY)
    chart.legend(picture, entries, (94, above + 330), chart.box_mark)
    if confidence is not None and np.isfinite(confidence).any():
        axes.line(picture, time_s, confidence, _SURE)
        lines = [("score", chart.GREEN), ("confidence", _SURE)]
        chart.legend(picture, lines, (axes.right - 260, above + 330))
    note = (
        "The recording has no truth, so there is no error to show."
        if error_mm is None
        else "The error is left out where the truth has no visible hand."
    )
    return chart.titled(picture, title, note)


def _span(time_s: np.ndarray) -> tuple[float, float]:
    """Limits of the axis of time, also of a single frame."""
    return float(time_s[0]), max(float(time_s[-1]), float(time_s[0]) + 1e-3)


def _error_limits(*errors: np.ndarray) -> tuple[float, float]:
    """Limits in mm that hold every error, from a round number to a round number."""
    values = np.concatenate(errors)
    values = values[np.isfinite(values) & (values > 0)]
    if not len(values):
        return 1.0, 100.0
    steps = np.array([f * 10.0**power for power in range(-3, 6) for f in (1, 2, 5)])
    low = steps[steps <= max(values.min(), 0.1)].max(initial=0.1)
    high = steps[steps >= values.max()].min(initial=1e6)
    return float(min(low, high / 10)), float(high)


def latent_figure(
    space: PoseSpace,
    latent: np.ndarray,
    lost: np.ndarray,
    time_s: np.ndarray,
    title: str,
    note: str = "",
) -> np.ndarray:
    """The way of the estimates over the manifold: coordinates 1-2 and 3-4 with the training poses.

    Args:
        space: its training poses are coloured by the nearest gesture.
        latent: (T, d), NaN where there was no estimate.
        lost, time_s: (T,).
        note: what else is to be said, after the explanation.
    """
    # Angles in a linear space are angles; the coordinates of others have no unit.
    linear = space.kind == "pca"
    scale, unit = (180 / np.pi, ", degrees") if linear else (1.0, "")
    training = scale * space.training_latents.cpu().numpy()
    gestures = nearest_gestures(space.decode(space.training_latents))
    path = scale * latent
    bounds = scale * np.stack([space.lower.cpu().numpy(), space.upper.cpu().numpy()])
    pairs = [(i, min(i + 1, space.dims - 1)) for i in range(0, min(space.dims, 4), 2)]
    panels = [
        _latent_panel(training, gestures, path, lost, time_s, bounds, pair, unit) for pair in pairs
    ]
    body = np.hstack([*panels, _time_bar(time_s, panels[0].shape[0])])
    foot = chart.canvas(44, body.shape[1])
    entries = [(name, colour) for name, colour in BASIC_BGR.items()]
    chart.legend(foot, [*entries, ("other training poses", chart.GREY)], (30, 24))
    chart.legend(foot, [("estimates", chart.TEXT)], (body.shape[1] - 330, 24), _dot)
    chart.legend(foot, [("lost", chart.TEXT)], (body.shape[1] - 200, 24), _cross)
    about = (
        "Training poses (large dots) by their nearest gesture, and over them the way of the "
        "estimates. The rectangle is the range of the training poses, to which the particles keep."
    )
    return chart.titled(np.vstack([body, foot]), title, about + note)


def _latent_panel(
    training: np.ndarray,
    gestures: Sequence[str | None],
    path: np.ndarray,
    lost: np.ndarray,
    time_s: np.ndarray,
    bounds: np.ndarray,
    pair: tuple[int, int],
    unit: str,
    size: int = 520,
) -> np.ndarray:
    i, j = pair
    picture = chart.canvas(size, size)
    finite = np.isfinite(path).all(1)
    everything = np.concatenate([training, bounds, path[finite]])[:, (i, j)]
    low, high = everything.min(0), everything.max(0)
    margin = 0.04 * np.maximum(high - low, 1e-6)
    (x0, y0), (x1, y1) = low - margin, high + margin
    axes = Axes(70, size - 20, 50, size - 60, (float(x0), float(x1)), (float(y0), float(y1)))
    axes.draw(picture, f"coordinate {i + 1}{unit}", f"coordinate {j + 1}{unit}")
    corners = np.round(axes.place(bounds[:, i], bounds[:, j])).astype(int).tolist()
    cv2.rectangle(picture, corners[0], corners[1], chart.GREY, 1)
    for point, gesture in zip(training, gestures, strict=True):
        colour = BASIC_BGR[gesture] if gesture else chart.GREY
        pale = tuple(int(255 - 0.55 * (255 - c)) for c in colour)
        spot = np.round(axes.place(point[i], point[j])).astype(int)
        cv2.circle(picture, spot, 6, pale, -1, cv2.LINE_AA)
        cv2.circle(picture, spot, 6, colour, 1, cv2.LINE_AA)
    spots = np.round(np.nan_to_num(axes.place(path[:, i], path[:, j])) * 8).astype(np.int32)
    colours = _time_colours(time_s)
    for row in np.flatnonzero(finite):
        if row and finite[row - 1]:
            ends = (spots[row - 1].tolist(), spots[row].tolist())
            cv2.line(picture, *ends, colours[row], 1, cv2.LINE_AA, 3)
    for row in np.flatnonzero(finite):
        if lost[row]:
            _cross(picture, tuple((spots[row] // 8).tolist()), colours[row])
        else:
            cv2.circle(picture, spots[row].tolist(), 8 * 3, colours[row], -1, cv2.LINE_AA, 3)
    return picture


def _dot(picture: np.ndarray, centre: tuple[int, int], colour: chart.Colour) -> None:
    cv2.circle(picture, centre, 3, colour, -1, cv2.LINE_AA)


def _cross(picture: np.ndarray, centre: tuple[int, int], colour: chart.Colour) -> None:
    cv2.drawMarker(picture, centre, colour, cv2.MARKER_TILTED_CROSS, 9, 2, cv2.LINE_AA)


def _time_colours(time_s: np.ndarray) -> list[chart.Colour]:
    """Of each frame, dark to bright; the brightest third would not be seen on white."""
    start, end = _span(time_s)
    shades = np.round(180 * (time_s - start) / (end - start)).astype(np.uint8)
    colours = cv2.applyColorMap(shades[:, None], cv2.COLORMAP_INFERNO)[:, 0]
    return [(int(b), int(g), int(r)) for b, g, r in colours]


def _time_bar(time_s: np.ndarray, height: int) -> np.ndarray:
    picture = chart.canvas(height, 110)
    start, end = _span(time_s)
    axes = Axes(20, 40, 50, height - 60, (0.0, 1.0), (start, end))
    shades = np.linspace(end, start, axes.bottom - axes.top)
    column = np.array(_time_colours(shades[::-1])[::-1], np.uint8)
    picture[axes.top : axes.bottom, axes.left : axes.right] = column[:, None]
    chart.write(picture, "time, s", (axes.left - 8, axes.top - 14))
    for tick in chart.ticks(start, end, 6):
        v = float(axes.place(0.0, tick)[1])
        chart.write(picture, f"{tick:g}", (axes.right + 8, v + 5), size=0.45)
    return picture
