"""Figures of a finished run, as the paper has them (figs. 3, 5, 6), and its course over time.

Pictures are (h, w, 3) uint8 BGR. Of a run with several slots, `run` is as if only one had been
followed (Run.slot) where a figure is of one hand, and `of` is what its title begins with.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from toftrack.evaluation.trust import joint_errors_mm
from toftrack.frames.estimate import confidence_words, state_words
from toftrack.frames.frame import Truth
from toftrack.output.run_folder import Footage, Run, observe
from toftrack.pose_space.base import PoseSpace
from toftrack.views.classified import CLASS_RGB, CLASSES, classify
from toftrack.views.figures import chart
from toftrack.views.figures.poses import scatter_gestures
from toftrack.views.overlay import draw_panel, film_tile, filmstrip, range_grey

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARGIN_PX = 8
_FILM_FRAMES = 10
_LOST_FRAMES = 5
_APART = 3
"""Frames of the lowest score are at least so far from one another."""
_SAME_SPACE = 0.01
"""Of a coordinate's range: a pose that is encoded elsewhere now is of another space."""


def _strip(run: Run, footage: Footage, rows: Iterable[int]) -> np.ndarray:
    """Frames of all slots as the overlay shows them."""
    tiles = []
    for row in rows:
        images = footage.depth(row), footage.amplitude(row)
        panel = draw_panel(*images, footage.camera, run.estimates(row), run.shapes)
        tiles.append(film_tile(panel))
    return filmstrip(tiles)


def measurement_figure(run: Run, footage: Footage, row: int, of: str) -> np.ndarray:
    """How one hypothesis is measured: input, range image, neighbourhood, classified (fig. 3).

    The observation's grid, cut to where something is counted.
    """
    estimate = run.estimate(row)
    observation = observe(run, footage, row)
    range_m, labels = classify(estimate.state, run.shape, observation, run.likelihood())
    hand, depth = observation.hand.cpu().numpy(), observation.depth_m.cpu().numpy()
    counted = (labels > 0) | (range_m > 0)
    shown = counted if counted.any() else hand
    ends = [np.flatnonzero(shown.any(axis))[[0, -1]] for axis in (1, 0) if shown.any()]
    here = tuple(slice(max(0, a - _MARGIN_PX), b + 1 + _MARGIN_PX) for a, b in ends)
    # In one go, so that the same grey is the same distance in both.
    greys = np.hsplit(range_grey(np.hstack([np.where(hand, depth, 0), range_m])), 2)
    near = np.full_like(greys[0], 255)
    near[labels > 0], near[range_m > 0] = 190, 60
    colours = np.array(CLASS_RGB, np.uint8)[labels]
    figure = chart.new_figure(
        1240, 90 + round(300 * colours[here].shape[0] / colours[here].shape[1])
    )
    panels = (
        (greys[0], "input, segmented"),
        (greys[1], "range image of the estimate"),
        (near, "its neighbourhood (grey)"),
        (colours, "classified pixels"),
    )
    for axes, (picture, caption) in zip(figure.subplots(1, 4), panels, strict=True):
        axes.imshow(picture[here], "gray", vmin=0, vmax=255, interpolation="nearest")
        axes.set(xticks=(), yticks=(), title=caption)
    names = [f"{(labels == n).sum()} {CLASSES[n]}" for n in (2, 3, 4)] + [CLASSES[1]]
    for name, rgb in zip(names, (*CLASS_RGB[2:], CLASS_RGB[1]), strict=True):
        axes.scatter([], [], marker="s", s=80, color=np.divide(rgb, 255), label=name)
    figure.legend(loc="outside lower left", ncols=4, frameon=False)
    state = f"LOST: {state_words(estimate)}" if estimate.lost else ""
    facts = (f"score {estimate.score:.2f}", confidence_words(estimate.confidence), state)
    title = f"{of}Frame {estimate.index}: " + ", ".join(filter(None, facts))
    note = "Nearer is darker, in both range images alike. Pixels as the likelihood counts them."
    return chart.titled(chart.picture_of(figure), title, note)


def filmstrip_figure(run: Run, footage: Footage) -> np.ndarray:
    """Frames with the skeleton, below each the model's range image (fig. 5), of all slots."""
    count = min(_FILM_FRAMES, len(run))
    rows = np.linspace(0, len(run) - 1, count).round().astype(int)
    title = f"{count} of {len(run)} frames; lost in all: {run.summary['lost_frames']}"
    note = (
        "Above: the camera's image with the estimated skeleton. Below: the range image of the "
        "estimate, nearer is darker. Red: lost."
    )
    strip = _strip(run, footage, rows)
    return chart.titled(strip, title if count < len(run) else f"{count} frames", note)


def lost_figure(run: Run, one: Run, footage: Footage, of: str) -> np.ndarray:
    """Frames that went wrong above the course of the score, in which they are marked (fig. 6).

    one: slot of the run; the frames show all of them.
    """
    lost, score, time_s = one.results["lost"], np.nan_to_num(one.results["score"]), _time(run)
    if lost.any():
        # Of a time in which there was nothing to see, one frame is enough.
        nothing = lost & (score == 0)
        among = np.flatnonzero(lost & ~(nothing & np.roll(nothing, 1)))
        among = among if len(among) else np.flatnonzero(lost)
        count = min(_LOST_FRAMES, len(among))
        rows = among[np.linspace(0, len(among) - 1, count).round().astype(int)].tolist()
        title = f"Lost: {int(lost.sum())} of {len(run)} frames, {count} of them shown"
    else:
        rows = _lowest_rows(score)
        title = f"No frame was lost: the {len(rows)} frames of the lowest score"
    strip = _strip(run, footage, rows)
    width = max(strip.shape[1], 1000)
    strip = np.pad(strip, ((0, 0), (0, width - strip.shape[1]), (0, 0)), constant_values=255)
    figure = chart.new_figure(width, 340)
    axes = figure.subplots()
    _draw_score(axes, one, score)
    axes.plot(time_s[rows], score[rows], "o", color=chart.VERMILLION, label="frames shown above")
    _number_frames(axes, time_s[rows], run.frames[rows])
    figure.legend(loc="outside lower left", ncols=4, frameon=False)
    note = "Above: the camera's image with the estimated skeleton, and the estimate's range image."
    return chart.titled(np.vstack([strip, chart.picture_of(figure)]), of + title, note)


def _lowest_rows(score: np.ndarray) -> list[int]:
    rows: list[int] = []
    for row in np.argsort(score, kind="stable").tolist():
        if all(abs(row - other) >= _APART for other in rows):
            rows.append(row)
        if len(rows) == _LOST_FRAMES:
            break
    return sorted(rows)


def course_figure(run: Run, truth: Truth | None, metrics: dict[str, Any], of: str) -> np.ndarray:
    """Error against the truth, if there is one, score and confidence over time, lost frames shaded.

    truth, metrics: of the hand that is followed.
    """
    from matplotlib.ticker import MaxNLocator

    results, time_s = run.results, _time(run)
    score = np.where(np.isfinite(results["score"]), results["score"], np.nan)
    error_mm = None
    if truth is not None:
        there, error_mm = joint_errors_mm(results["joints_m"], truth)
        error_mm[~(there & truth.visible)] = np.nan
    count = 1 if error_mm is None else 2
    figure = chart.new_figure(1100, 330 * count)
    *above, below = figure.subplots(count, squeeze=False)[:, 0]
    if error_mm is not None:
        axes = above[0]
        chart.label(axes, "", "joint error, mm (logarithmic)")
        chart.shade(axes, time_s, results["lost"], chart.SHADE, "")
        axes.plot(time_s, error_mm.max(1), ".-", color=chart.ORANGE, label="largest of a joint")
        axes.plot(time_s, error_mm.mean(1), ".-", color=chart.BLUE, label="mean of the joints")
        chart.round_log_ticks(axes, "y")
        axes.set_xlim(*_span(time_s))
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)
    _draw_score(below, run, score)
    if truth is not None:
        name = "no hand is visible, says the truth"
        chart.shade(below, time_s, ~truth.visible, chart.GREY, name, top=0.96)
    round_numbers = MaxNLocator(10, integer=True).tick_values(run.frames[0], run.frames[-1])
    at = np.flatnonzero(np.isin(run.frames, round_numbers))
    _number_frames(below, time_s[at], run.frames[at])
    figure.legend(
        *below.get_legend_handles_labels(), loc="outside lower left", ncols=4, frameon=False
    )
    note = (
        "The recording has no truth, so there is no error to show."
        if error_mm is None
        else "The error is left out where the truth has no visible hand."
    )
    title = f"Score of {len(run)} frames"
    if (mean := metrics.get("trust", {}).get("mean_mm")) is not None:
        height = float(np.nanmean(score))
        title = (
            f"{len(run)} frames: mean joint error {mean:.1f} mm where not lost, score {height:.2f}"
        )
    return chart.titled(chart.picture_of(figure), of + title, note)


def _time(run: Run) -> np.ndarray:
    """(T,) seconds since the first frame."""
    return run.timestamp_s - run.timestamp_s[0]


def _draw_score(axes: Axes, run: Run, score: np.ndarray) -> None:
    """Score (T,) and confidence over time, lost frames shaded."""
    time_s, confidence = _time(run), run.results["confidence"]
    chart.label(axes, "time, s", "score")
    chart.shade(axes, time_s, run.results["lost"], chart.SHADE, "lost, says the tracker")
    marker = "o" if len(time_s) == 1 else ""  # which is no line
    axes.plot(time_s, score, marker=marker, color=chart.GREEN, label="score")
    if np.isfinite(confidence).any():
        axes.plot(time_s, confidence, marker=marker, color=chart.PURPLE, label="confidence")
    axes.set(xlim=_span(time_s), ylim=(0, 1.02))


def _number_frames(axes: Axes, time_s: np.ndarray, frames: np.ndarray) -> None:
    """Frame numbers at the upper edge; those that would overlap are left out."""
    apart = np.ptp(axes.get_xlim()) / 30
    kept: list[int] = []
    for row, time in enumerate(time_s):
        if not kept or time - time_s[kept[-1]] > apart:
            kept.append(row)
    upper = axes.twiny()
    upper.set(xlim=axes.get_xlim(), xlabel="frame")
    upper.set_xticks(time_s[kept], frames[kept])


def _span(time_s: np.ndarray) -> tuple[float, float]:
    """Limits of the axis of time, also of a single frame."""
    return float(time_s[0]), max(float(time_s[-1]), float(time_s[0]) + 1e-3)


def latents(run: Run, space: PoseSpace) -> tuple[np.ndarray, str]:
    """(T, d) coordinates of the estimates in the space as it is now, NaN where there were none, and
    what is to be said of them.
    """
    latent = run.results["latent"]
    with torch.inference_mode():
        now = space.encode(torch.from_numpy(run.results["state"][:, 6:])).numpy()
    span = (space.upper - space.lower).numpy()
    if np.nanmax(np.abs(now - latent) / span, initial=0.0) > _SAME_SPACE:
        return now, " The space has changed since the run; its poses are encoded anew."
    return latent, ""


def latent_figure(run: Run, of: str) -> np.ndarray:
    """The way of the estimates over the manifold: coordinates 1-2 and 3-4 with the training poses,
    which are coloured by the nearest gesture.
    """
    space, lost, time_s = run.pose_space(), run.results["lost"], _time(run)
    latent, note = latents(run, space)
    # Angles in a linear space are angles; the coordinates of others have no unit.
    linear = space.kind == "pca"
    scale, unit = (180 / np.pi, ", degrees") if linear else (1.0, "")
    training = scale * space.training_latents.cpu().numpy()
    low, high = (scale * bound.cpu().numpy() for bound in (space.lower, space.upper))
    path = scale * latent
    pairs = [[i, min(i + 1, space.dims - 1)] for i in range(0, min(space.dims, 4), 2)]
    figure = chart.new_figure(110 + 520 * len(pairs), 560)
    panels = figure.subplots(1, len(pairs), squeeze=False)[0]
    for pair, axes in zip(pairs, panels, strict=True):
        i, j = pair
        chart.label(axes, f"coordinate {i + 1}{unit}", f"coordinate {j + 1}{unit}")
        corners = [low[i], low[i], high[i], high[i]], [low[j], high[j], high[j], low[j]]
        axes.fill(*corners, facecolor="none", edgecolor=chart.GREY)
        scatter_gestures(axes, space, training[:, pair])
        axes.plot(*path[:, pair].T, color="black", linewidth=0.5)
        for where, mark, name in ((~lost, ".", "estimates"), (lost, "x", "lost")):
            axes.scatter([], [], color="black", marker=mark, label=name)
            times = {"c": time_s[where], "vmin": time_s[0], "vmax": _span(time_s)[1]}
            # Bright ends of other maps would not be seen on white.
            look = {"cmap": "copper", "marker": mark, "zorder": 3}
            dots = axes.scatter(*path[where][:, pair].T, 30, **times, **look)
    figure.colorbar(dots, ax=panels, label="time, s")
    figure.legend(
        *axes.get_legend_handles_labels(), loc="outside lower left", ncols=6, frameon=False
    )
    about = (
        "Training poses (large dots) by their nearest gesture, and over them the way of the "
        "estimates. The rectangle is the range of the training poses, to which the particles keep; "
        "an estimate may lie beyond it, because the refinement is free of it."
    )
    kind = f"({space.kind}, {space.dims} coordinates)"
    title = f"{of}Pose space {kind}: training poses and estimates"
    return chart.titled(chart.picture_of(figure), title, about + note)


_PARTS = (
    ("usable", "usable_pct", chart.GREEN),
    ("partly", "partly_pct", chart.SKY),
    ("false alarm", "false_alarm_pct", chart.BLUE),
    ("silently wrong", "silent_pct", chart.VERMILLION),
)


def accuracy_figure(each: Mapping[str, Mapping[str, Any]], total: Mapping[str, Any]) -> np.ndarray:
    """A bar a recording and one for their mean, BGR.

    each: figures of recordings, see evaluation/rows.py.  total: theirs, with `usable_90`, which is
    drawn as a line across its end.
    """
    rows = {**each, "mean of the recordings": total}
    figure = chart.new_figure(1000, 110 + 26 * len(rows))
    axes = figure.subplots()
    begin = np.zeros(len(rows))
    for name, key, colour in _PARTS:
        share = np.minimum([row.get(key) or 0.0 for row in rows.values()], 100 - begin)
        axes.barh(list(rows), share, left=begin, color=colour, label=name)
        begin += share
    axes.barh(list(rows), 100 - begin, left=begin, color="#ebebeb", label="flagged, rightly")
    if ends := total.get("usable_90"):
        axes.plot(ends, [len(rows) - 1] * 2, "k|-")
    for number, row in enumerate(rows.values()):
        if row.get("mean_all_mm") is not None:
            axes.text(101, number, f"{row['mean_all_mm']:.1f} mm", va="center")
    axes.set(xlim=(0, 100), ylim=(len(rows) - 0.4, -0.6), xlabel="% of the visible frames")
    axes.set_xticks(range(0, 101, 10))
    figure.legend(loc="outside upper center", ncols=5, frameon=False)
    several = "s" if total["seeds"] > 1 else ""
    note = (
        f"{total['recordings']} recordings, {total['seeds']} seed{several}. Beside the bars "
        "the mean joint error over all visible frames, across the last one the 90 % interval of "
        "usable. Silently wrong ones are % of all frames."
    )
    return chart.titled(chart.picture_of(figure), "What the frames are", note)
