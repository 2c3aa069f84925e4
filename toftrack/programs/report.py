"""What a sweep found: `toftrack report multirun/DIR`.

Gathers the overrides (.hydra/overrides.yaml) and the figures (summary.json) of every job, or run,
below a folder into sweep.csv, sweep.png and a table. For each choice of settings it shows a
figure's mean over the runs, its standard deviation over seeds (spread), and the median time of a
frame. Jobs that failed are named and left out of the means. To compare settings with intervals,
use `toftrack benchmark accuracy --compare`.
"""

from __future__ import annotations

import csv
import io
import math
import os
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from toftrack.errors import ToftrackError, one_line, reported_errors
from toftrack.evaluation.statistics import text_of
from toftrack.files.json_text import read_json
from toftrack.files.safe_files import natural_order, open_to_read, write_whole
from toftrack.programs.command_line import plain_parser
from toftrack.views.figures import chart

_FIGURES = (
    *("metrics.mean_mm", "metrics.trust.mean_all_mm", "mean_score"),
    *("reached_degrees", "training_degrees"),
)
"""What to compare by: joint error of the frames in the pose space, or of all, where a recording has
none in it; score without truth; of train_pose_space.py, degrees."""
_HELD_OUT = "reached_degrees"
"""It is compared also where some spaces have none, for too few poses were left to learn them: by
their own training poses those with most dimensions are always the best."""

_SEED = "seed"
_RECORDING = "device.path"
"""Which recording a job tracked: averaged over, and shown apart where there are several."""


@dataclass(frozen=True)
class Run:
    """One job of a sweep."""

    name: str
    """Its folder below the sweep's."""
    overrides: dict[str, str]
    figures: dict[str, float]
    """Numbers of summary.json, nested names joined by dots."""
    error: str | None = None
    """Why it failed."""
    complete: bool = True
    """Nothing ended it early."""


@dataclass(frozen=True)
class Group:
    """The runs that differ only in the seed and the recording."""

    settings: str
    """The overrides that tell groups apart."""
    runs: list[Run]
    error: float | None
    """Mean over the runs, as cost_ms; None without any."""
    spread: float | None
    """Deviation over seeds of the mean over recordings; None below two seeds."""
    cost_ms: float | None
    recordings: dict[str, float]
    """The mean error of each."""


def read_runs(folder: str | Path) -> list[Run]:
    """Every job below a folder, in the order of their numbers; ToftrackError when there is none."""
    folder = Path(folder)
    found = [path.parents[1] for path in folder.rglob(".hydra/overrides.yaml")]
    if not found:
        raise ToftrackError(
            f"there is no folder '{folder}' with jobs (.hydra/overrides.yaml) below; give that of a"
            " sweep, multirun/DATE/TIME"
        )

    found.sort(key=lambda path: natural_order(path.as_posix()))
    return [_read_run(path, folder) for path in found]


def _read_run(path: Path, folder: Path) -> Run:
    name = _printable(path.relative_to(folder).as_posix())
    try:
        with open_to_read(path / ".hydra" / "overrides.yaml") as stream:
            lines = yaml.safe_load(stream.read().decode("utf-8"))
        given = (_printable(line).partition("=") for line in lines)
        overrides = {key.lstrip("+~"): value for key, _, value in given}
    except Exception as error:  # whatever a YAML reader may say about a damaged file
        return Run(name, {}, {}, f"its overrides cannot be read ({type(error).__name__})")
    try:
        summary = read_json(path / "summary.json")
        if not isinstance(summary, dict):
            raise ValueError("it is not one of track.py")
    except FileNotFoundError:
        return Run(name, overrides, {}, "it left no summary.json: it did not finish")
    except (OSError, ValueError) as error:
        why = f"its summary.json cannot be read ({_printable(str(error))})"
        return Run(name, overrides, {}, why)
    told = summary.get("error")
    complete = summary.get("complete") is not False
    failed = None if told is None else _printable(str(told))
    return Run(name, overrides, _flat(summary), failed, complete)


def _printable(text: str) -> str:
    """A text as UTF-8 has it: names of files and JSON may hold what no file or terminal takes."""
    return one_line(text).encode("utf-8", "backslashreplace").decode()


def _flat(summary: dict[str, Any], prefix: str = "") -> dict[str, float]:
    figures: dict[str, float] = {}
    for name, value in summary.items():
        if isinstance(value, dict):
            figures |= _flat(value, f"{prefix}{name}.")
        elif type(value) in (int, float) and math.isfinite(value):
            figures[_printable(prefix + name)] = value
    return figures


def group_runs(runs: Sequence[Run], figure: str) -> list[Group]:
    """Groups in the order of their first run, with the mean and the spread of a figure."""
    varied = [key for key in _varied(runs) if key not in (_SEED, _RECORDING)]
    groups: dict[str, list[Run]] = {}
    for run in runs:
        settings = " ".join(f"{key}={run.overrides.get(key, '-')}" for key in varied) or "all alike"
        groups.setdefault(settings, []).append(run)
    return [_group(settings, members, figure) for settings, members in groups.items()]


def _varied(runs: Sequence[Run]) -> list[str]:
    """Overrides in which runs differ."""
    return [key for key in _keys(runs) if len({run.overrides.get(key) for run in runs}) > 1]


def _keys(runs: Sequence[Run]) -> list[str]:
    return list(dict.fromkeys(key for run in runs for key in run.overrides))


def _group(settings: str, runs: list[Run], figure: str) -> Group:
    good = [run for run in runs if run.error is None and figure in run.figures]
    by_seed, by_recording = _parts(good, _SEED), _parts(good, _RECORDING)
    # A seed that failed on a recording would compare other recordings: only complete seeds count.
    complete = [
        _mean(members, figure)
        for members in by_seed.values()
        if len(_parts(members, _RECORDING)) == len(by_recording)
    ]
    # The median: the mean has what is compiled or loaded once.
    timed = [run for run in good if "median_ms" in run.figures]
    return Group(
        settings,
        runs,
        error=_mean(good, figure) if good else None,
        spread=statistics.stdev(complete) if len(complete) > 1 else None,
        cost_ms=_mean(timed, "median_ms") if timed else None,
        recordings={name: _mean(part, figure) for name, part in by_recording.items()},
    )


def _parts(runs: Sequence[Run], key: str) -> dict[str, list[Run]]:
    """The runs by an override; sorted."""
    parts: dict[str, list[Run]] = {}
    for run in runs:
        value = run.overrides.get(key, "")
        value = os.path.normpath(value) if key == _RECORDING and value else value
        parts.setdefault(value, []).append(run)
    return dict(sorted(parts.items()))


def _short_names(paths: Sequence[str]) -> list[str]:
    """Recordings as a table tells them apart: without what all folders share, and endings."""
    names = [(*Path(path).parent.parts, Path(path).stem) for path in paths]
    shared = len(os.path.commonprefix([name[:-1] for name in names]))
    short = ["/".join(name[shared:]).replace("//", "/") for name in names]
    return [
        name + Path(path).suffix if short.count(name) > 1 else name
        for name, path in zip(short, paths, strict=True)
    ]


def _mean(runs: Sequence[Run], name: str) -> float:
    return statistics.fmean(run.figures[name] for run in runs)


def _write_csv(runs: Sequence[Run], path: Path) -> None:
    """One row a job: its folder, its overrides, its figures, its error."""
    overrides = _keys(runs)
    figures = list(dict.fromkeys(key for run in runs for key in run.figures))
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(["run", *overrides, *figures, "error"])
    for run in runs:
        given = [run.overrides.get(key, "") for key in overrides]
        found = [run.figures.get(key, "") for key in figures]
        writer.writerow([run.name, *given, *found, run.error or ""])
    write_whole(path, text.getvalue())


def _table(groups: Sequence[Group], figure: str) -> str:
    """The groups as text for the terminal; a second block by recording where there are several."""
    digits, column = 2 if figure.endswith("_mm") else 3, figure.removeprefix("metrics.")
    wide = max(10, len(column))
    lines = [f" #  runs failed  {column:>{wide}}   spread    ms/frame  settings"]
    for number, group in enumerate(groups, 1):
        failed = sum(run.error is not None for run in group.runs)
        error, spread = text_of(group.error, digits), text_of(group.spread, digits)
        lines.append(
            f"{number:2d} {len(group.runs):5d} {failed:6d}  {error:>{wide}} {spread:>8}"
            f"  {text_of(group.cost_ms, 1):>10}  {group.settings}"
        )
    names = list(dict.fromkeys(name for group in groups for name in group.recordings))
    if len(names) > 1:
        short = _short_names(names)
        width = max(8, *map(len, short))
        lines += ["", " #  " + " ".join(f"{name:>{width}}" for name in short)]
        for number, group in enumerate(groups, 1):
            cells = [text_of(group.recordings.get(name), digits) for name in names]
            lines.append(f"{number:2d}  " + " ".join(f"{cell:>{width}}" for cell in cells))
    done = [run for group in groups for run in group.runs if run.error is None]
    if without := sum(figure not in run.figures for run in done):
        lines.append(f"{without} of {len(done)} runs have no {figure}; the means are without them")
    if early := [run.name for run in done if not run.complete]:
        lines.append(
            f"{len(early)} of {len(done)} runs were interrupted, and count with the frames they"
            f" have: {', '.join(early)}"
        )
    return "\n".join(lines)


def report(folder: str | Path, figure: str | None = None) -> tuple[list[Run], list[Group]]:
    """Read a sweep, write sweep.csv and sweep.png into its folder, print the table.

    figure: a figure of summary.json such as metrics.fingertip_mm; None takes the first of _FIGURES
    that every good run has, or, of _HELD_OUT, any.

    Raises ToftrackError when there is no job, no job has the figure, or nothing can be written.
    """
    folder = Path(folder)
    runs = read_runs(folder)
    if figure is None:
        good = [run.figures for run in runs if run.error is None]
        needed = {name: any if name == _HELD_OUT else all for name in _FIGURES}
        found = (name for name, of in needed.items() if of(name in figures for figures in good))
        figure = next(found, _FIGURES[0])
    known = sorted({name for run in runs for name in run.figures})
    if known and figure not in known:
        raise ToftrackError(f"no job has the figure {figure}; known: {', '.join(known)}")
    groups = group_runs(runs, figure)
    with reported_errors(f"{folder} cannot be written", "copy it to where it can be"):
        _write_csv(runs, folder / "sweep.csv")
    print(_table(groups, figure))
    failed = [run for run in runs if run.error is not None]
    if failed:
        print(f"\n{len(failed)} of {len(runs)} jobs failed:")
        varied = _varied(runs)
        for run in failed:
            changed = " ".join(f"{k}={value}" for k, value in run.overrides.items() if k in varied)
            print(f"  {run.name} ({changed}): {run.error}")
    written = [folder / "sweep.csv"]
    points = [group for group in groups if None not in (group.error, group.cost_ms)]
    if points:
        label = f"{figure.removeprefix('metrics.')}, mean over recordings"
        written += chart.write_figures(folder, [("sweep.png", lambda: sweep_figure(points, label))])
    print("\n" + "\n".join(_printable(f"  {path}") for path in written))
    return runs, groups


def main(arguments: Sequence[str]) -> None:
    """The command line; jobs of the sweep that failed are no error. Raises ToftrackError."""
    parser = plain_parser("toftrack report", __doc__)
    about = "that of the sweep, multirun/DATE/TIME, or one into which you moved runs to compare"
    parser.add_argument("folder", nargs="+", help=about)
    about = (
        "a figure of summary.json, as metrics.fingertip_mm; default metrics.mean_mm, the mean joint"
        " error of frames in the pose space from the sixth on, or metrics.trust.mean_all_mm, that"
        " of all frames, if a recording has no such frames"
    )
    parser.add_argument("--figure", help=about)
    given = parser.parse_args(arguments)
    if len(given.folder) > 1:
        raise ToftrackError(
            f"toftrack report takes one folder, but {len(given.folder)} are given; to compare runs,"
            " move them into one and give that"
        )
    report(given.folder[0], given.figure)


def sweep_figure(groups: Sequence[Group], label: str) -> np.ndarray:
    """Numbered dots with bars of one deviation over seeds, a legend below; BGR.

    groups: with an error and a cost.  label: of the error's axis, which starts at zero. The axis of
    the cost is logarithmic.
    """
    figure = chart.new_figure(900, 500 + 22 * len(groups))
    axes = figure.subplots()
    chart.label(axes, "ms a frame", label)
    for number, group in enumerate(groups, 1):
        colour = chart.COLOURS[(number - 1) % len(chart.COLOURS)]
        at, name = (max(group.cost_ms or 0, 1e-3), group.error), f"{number}  {group.settings}"
        axes.errorbar(*at, group.spread, fmt="o", color=colour, capsize=5, label=name)
        axes.annotate(str(number), at, (7, 5), textcoords="offset points", color=colour)
    chart.round_log_ticks(axes, "x")
    axes.margins(0.15, 0.1)
    axes.set_ylim(bottom=0)
    figure.legend(loc="outside lower left", frameon=False)
    return chart.picture_of(figure)
