"""Pictures of a finished run, as in the paper: `toftrack figures outputs/DATE/TIME`.

Writes five PNG files into the run's folder, below `figures`:

  measurement.png   a frame's input, range image, neighbourhood, classified pixels (fig. 3)
  filmstrip.png     ten frames with the skeleton, and the estimates' range images (fig. 5)
  lost.png          frames that were lost, else those of the lowest score, with scores (fig. 6)
  course.png        joint error against the truth, score and confidence over time
  latent.png        the path of the estimates over the training poses

The first three need the recording that the run tracked; a run with a live camera has none, so only
the others are drawn. With several hands, the figures of the second slot are `measurement_2.png` and
so on; the filmstrip shows all hands.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.safe_files import make_folder
from toftrack.frames.frame import Truth
from toftrack.output.run_folder import Footage, Run, read_run
from toftrack.programs.command_line import note, plain_parser
from toftrack.views.figures.chart import new_figure, write_figures
from toftrack.views.figures.runs import (
    course_figure,
    filmstrip_figure,
    latent_figure,
    lost_figure,
    measurement_figure,
)


def main(arguments: Sequence[str]) -> None:
    """Parse the command line and draw. Raises ToftrackError."""
    parser = plain_parser("toftrack figures", __doc__)
    parser.add_argument("run", metavar="RUN_DIR", help="the output folder of toftrack track")
    parser.add_argument("--recording", metavar="FILE", help="where the recording is now")
    parser.add_argument("--out", metavar="DIR", help="write here instead of RUN_DIR/figures")
    about = "the frame of measurement.png (default: one with the median score)"
    parser.add_argument("--frame", type=int, metavar="N", help=about)
    options = parser.parse_args(arguments)
    for path in draw_figures(options.run, options.recording, options.out, options.frame):
        print(f"  {path}")


def draw_figures(
    folder: str | Path,
    recording: str | Path | None = None,
    out: str | Path | None = None,
    frame: int | None = None,
) -> list[Path]:
    """Draw and write the figures of a run; returns the files. The arguments are the command's.
    Raises ToftrackError when the folder is no run's, the recording is gone or another one, the run
    has no such frame, matplotlib is missing, or nothing can be written.
    """
    new_figure(1, 1)  # better missed now than when the recording is open
    run = read_run(folder)
    footage = run.footage(recording)
    figures: dict[str, Callable[[], np.ndarray]] = {}
    if footage is None:
        if frame is not None:
            raise ToftrackError("a run with a live camera has no images to draw --frame from")
        note(
            "the run tracked a live camera, whose images are not kept; only the figures without "
            "them are drawn"
        )
    every = range(len(run.shapes))
    # Those that had a hand; the first one where none had.
    slots = [n for n in every if np.isfinite(run.slot(n).results["joints_m"]).any()] or [0]
    for slot in slots:
        figures |= _of_slot(run, footage, slot, frame, with_film=slot == slots[0])
    target = Path(out).expanduser() if out is not None else run.folder / "figures"
    with (
        nullcontext() if footage is None else closing(footage.store),
        reported_errors(f"'{target}' cannot be written", "give another folder with --out"),
    ):
        # The folder within the run's must be no link; which one --out is, the user says.
        make_folder(target) if out is None else target.mkdir(parents=True, exist_ok=True)
        drawn = [(f"{name}.png", draw) for name, draw in figures.items()]
        bar = tqdm(drawn, unit=" figures", file=sys.stderr, delay=1.0, leave=False, disable=None)
        written = write_figures(target, bar)
    if not written:
        raise ToftrackError("no figure could be drawn; the notes above say why")
    return written


def _of_slot(
    run: Run, footage: Footage | None, slot: int, frame: int | None, with_film: bool
) -> dict[str, Callable[[], np.ndarray]]:
    """The figures of one slot by their names, and of all, with_film, the filmstrip."""
    one = run.slot(slot)
    after = f"_{slot + 1}" if slot else ""
    of = f"Slot {slot}, {one.shape.side} hand. " if len(run.shapes) > 1 else ""
    row = _row(one, frame)
    figures: dict[str, Callable[[], np.ndarray]] = {}
    if footage is not None:
        figures[f"measurement{after}"] = lambda: measurement_figure(one, footage, row, of)
        if with_film:
            figures["filmstrip"] = lambda: filmstrip_figure(run, footage)
        figures[f"lost{after}"] = lambda: lost_figure(run, one, footage, of)
    truth, metrics = _truth(run, footage, slot)
    figures[f"course{after}"] = lambda: course_figure(one, truth, metrics, of)
    figures[f"latent{after}"] = lambda: latent_figure(one, of)
    return figures


def _truth(run: Run, footage: Footage | None, slot: int) -> tuple[Truth | None, dict[str, Any]]:
    """Of the hand that a slot followed, and the metrics of that."""
    truth = None if footage is None else footage.truth
    metrics = run.summary.get("metrics") or {}
    if metrics.get("slot", slot) == slot:
        return truth, metrics
    second = metrics.get("second") or {}
    return (None, {}) if truth is None or not second else (truth.other, second)


def _row(run: Run, frame: int | None) -> int:
    """Of a frame; of none, the tracked one (any, if all are lost) of the most usual score."""
    if frame is None:
        lost, score = run.results["lost"], np.nan_to_num(run.results["score"])
        rows = np.flatnonzero(~lost) if not lost.all() else np.arange(len(run))
        return int(rows[np.abs(score[rows] - np.median(score[rows])).argmin()])
    rows = np.flatnonzero(run.frames == frame)
    if not len(rows):
        raise ToftrackError(
            f"the run has no frame {frame}; give --frame from {run.frames[0]} to {run.frames[-1]}"
        )
    return int(rows[0])
