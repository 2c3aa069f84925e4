"""Pictures of a finished run, as in the paper: `toftrack figures outputs/DATE/TIME`.

Writes five PNG files into the run's folder, below `figures`:

| file | what |
| --- | --- |
| `measurement.png` | a frame's input, range image, neighbourhood, classified pixels (fig. 3) |
| `filmstrip.png` | ten frames with the skeleton, and the estimates' range images (fig. 5) |
| `lost.png` | frames that were lost, else those of the lowest score, with their scores (fig. 6) |
| `course.png` | joint error against the truth, score and confidence over time |
| `latent.png` | the way of the estimates over the training poses |

The first three need the recording that the run tracked; of a run with a live camera there is none,
and only the others are drawn.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from tqdm import tqdm

from toftrack.errors import ToftrackError
from toftrack.estimate import confidence_words, state_words
from toftrack.output.run_folder import Footage, Run, observe, open_footage, read_run
from toftrack.render.model_image import model_range_image
from toftrack.views.classified import classify
from toftrack.views.figures.runs import (
    course_figure,
    filmstrip_figure,
    latent_figure,
    lost_figure,
    measurement_figure,
)
from toftrack.views.overlay import draw_panel, panel_scale

_FILM_FRAMES = 10
_LOST_FRAMES = 5
_APART = 3
"""Frames of the lowest score are at least so far from one another."""
_SAME_SPACE = 0.01
"""Of a coordinate's range: a pose that is encoded elsewhere now is of another space."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line and draw. Raises ToftrackError."""
    parser = argparse.ArgumentParser(
        prog="toftrack figures",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run", metavar="RUN_DIR", help="the output folder of track.py")
    parser.add_argument("--recording", metavar="FILE", help="where the recording is now")
    parser.add_argument("--out", metavar="DIR", help="instead of RUN_DIR/figures")
    parser.add_argument(
        "--frame", type=int, metavar="N", help="of measurement.png; default one of median score"
    )
    options = parser.parse_args(arguments)
    for path in draw_figures(options.run, options.recording, options.out, options.frame):
        print(f"  {path}")


def draw_figures(
    folder: str | Path,
    recording: str | Path | None = None,
    out: str | Path | None = None,
    frame: int | None = None,
) -> list[Path]:
    """Draw and write the figures of a run; returns the files.

    Args:
        folder: where track.py wrote.
        recording: where the recording is now, when it is not where it was.
        out: folder for the figures; None = `figures` in the run's.
        frame: number of the input frame of measurement.png; None takes one of median score.

    Raises:
        ToftrackError: the folder is no run's, the recording is gone or another one, the run has no
            such frame, or nothing can be written.
    """
    run = read_run(folder)
    footage = open_footage(run, recording)
    row = _typical_row(run) if frame is None else _row_of(run, frame)
    figures: dict[str, Callable[[], np.ndarray]] = {}
    if footage is None:
        if recording is None and frame is not None:
            raise ToftrackError("a run with a live camera has no images to draw --frame from")
        print(
            "note: the run tracked a live camera, whose images are not kept; only the figures "
            "without them are drawn",
            file=sys.stderr,
        )
    else:
        figures["measurement"] = lambda: _measurement(run, footage, row)
        figures["filmstrip"] = lambda: _film(run, footage)
        figures["lost"] = lambda: _lost(run, footage)
    figures["course"] = lambda: _course(run, footage)
    figures["latent"] = lambda: _latent(run)
    target = Path(out).expanduser() if out is not None else run.folder / "figures"
    try:
        target.mkdir(parents=True, exist_ok=True)
        written = []
        for name in tqdm(figures, unit=" figures", file=sys.stderr, delay=1.0, leave=False):
            path = target / f"{name}.png"
            if not cv2.imwrite(str(path), figures[name]()):
                raise ToftrackError(f"'{path}' cannot be written; give another folder with --out")
            written.append(path)
    except OSError as error:
        raise ToftrackError(
            f"'{target}' cannot be written ({error.strerror}); give another folder with --out"
        ) from error
    finally:
        if footage is not None:
            footage.store.close()
    return written


def _typical_row(run: Run) -> int:
    """The tracked frame (any, if all are lost) whose score is nearest to the median of them."""
    lost, score = run.results["lost"], run.results["score"]
    rows = np.flatnonzero(~lost) if not lost.all() else np.arange(len(run))
    return int(rows[np.abs(score[rows] - np.median(score[rows])).argmin()])


def _row_of(run: Run, frame: int) -> int:
    rows = np.flatnonzero(run.frames == frame)
    if not len(rows):
        raise ToftrackError(
            f"the run has no frame {frame}; give --frame from {run.frames[0]} to {run.frames[-1]}"
        )
    return int(rows[0])


def _panel(run: Run, footage: Footage, row: int) -> np.ndarray:
    estimate, camera = run.estimate(row), footage.camera
    model = model_range_image(estimate.state, run.shape, camera.K, camera.height, camera.width)
    return draw_panel(
        footage.depth(row),
        footage.amplitude(row),
        camera,
        estimate,
        model,
        panel_scale(camera.width),
    )


def _measurement(run: Run, footage: Footage, row: int) -> np.ndarray:
    estimate = run.estimate(row)
    observation = observe(run, footage, row)
    pixels = classify(estimate.state, run.shape, observation, run.likelihood())
    state = f"LOST: {state_words(estimate)}" if estimate.lost else ""
    facts = (f"score {estimate.score:.2f}", confidence_words(estimate.confidence), state)
    title = f"Frame {estimate.index}: " + ", ".join(filter(None, facts))
    return measurement_figure(observation, pixels, title)


def _film(run: Run, footage: Footage) -> np.ndarray:
    count = min(_FILM_FRAMES, len(run))
    rows = np.linspace(0, len(run) - 1, count).round().astype(int)
    title = f"{count} of {len(run)} frames; lost in all: {int(run.results['lost'].sum())}"
    if count == len(run):
        title = f"{count} frames"
    return filmstrip_figure([_panel(run, footage, row) for row in rows], title)


def _lost(run: Run, footage: Footage) -> np.ndarray:
    lost, score = run.results["lost"], run.results["score"]
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
    panels = [_panel(run, footage, row) for row in rows]
    sure = run.results.get("confidence")
    return lost_figure(panels, rows, _time(run), run.frames, score, lost, title, sure)


def _lowest_rows(score: np.ndarray) -> list[int]:
    rows: list[int] = []
    for row in np.argsort(score, kind="stable").tolist():
        if all(abs(row - other) >= _APART for other in rows):
            rows.append(row)
        if len(rows) == _LOST_FRAMES:
            break
    return sorted(rows)


def _course(run: Run, footage: Footage | None) -> np.ndarray:
    results, truth = run.results, None if footage is None else footage.truth
    error, absent = None, None
    if truth is not None:
        error = 1e3 * np.linalg.norm(results["joints_m"] - truth.joints_m, axis=-1)
        error[~truth.visible] = np.nan
        absent = ~(truth.visible & truth.in_space)
    score = np.where(np.isfinite(results["score"]), results["score"], np.nan)
    title = f"Score of {len(run)} frames"
    mean = (run.summary.get("metrics") or {}).get("mean_mm")
    if mean is not None:
        title = f"{len(run)} frames: mean joint error {mean:.1f} mm, mean score {score.mean():.2f}"
    lost, sure = results["lost"], results.get("confidence")
    return course_figure(_time(run), run.frames, score, lost, title, error, absent, sure)


def _latent(run: Run) -> np.ndarray:
    space, results = run.pose_space(), run.results
    latent, note = results["latent"], ""
    with torch.inference_mode():
        now = space.encode(torch.from_numpy(results["state"][:, 6:])).numpy()
    span = (space.upper - space.lower).numpy()
    if np.nanmax(np.abs(now - latent) / span, initial=0.0) > _SAME_SPACE:
        latent, note = now, " The space has changed since the run; its poses are encoded anew."
    title = f"Pose space ({space.kind}, {space.dims} coordinates): training poses and estimates"
    return latent_figure(space, latent, results["lost"], _time(run), title, note)


def _time(run: Run) -> np.ndarray:
    """(T,) seconds since the first frame."""
    return run.results["timestamp_s"] - run.results["timestamp_s"][0]
