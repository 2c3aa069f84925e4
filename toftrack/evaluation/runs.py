"""Tracking many recordings, each with several seeds, in this process or in several: rows of
figures, the same whatever the number of processes and threads."""

from __future__ import annotations

import functools
import multiprocessing
import signal
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from tqdm import tqdm

from toftrack.api import build_model
from toftrack.configuration.compose import configuration, one_sentence
from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.evaluation.image_labels import Points, Stills, point_rows, read_labels, still_row
from toftrack.evaluation.measures import Estimates, measured
from toftrack.evaluation.peer import PEER, peer_process
from toftrack.evaluation.rows import Row, group_counts, row_figures
from toftrack.frames.estimate import Estimate
from toftrack.frames.frame import Truth
from toftrack.recordings.npz import read_recording
from toftrack.tracking.model import FilterModel
from toftrack.tracking.tracker import HandsTracker

SIDES = ("told", "auto")
Reported = list[tuple[SimpleNamespace, ...]]
"""What was said of each frame in each slot."""
_FIELDS = ("joints_m", "lost", "joint_sigma_m", "joint_ok", "gesture")
"""What estimates are measured by; a peer's have the first two alone."""
_SIDE_FIELDS = ("side", "side_probability")
"""What is measured besides where the side is found out."""


@dataclass(frozen=True)
class Source:
    """A recording that can be measured.

    name: its folder's name and its own.  labels: of its images; None: it has truth.
    """

    path: Path
    name: str
    frames: int
    labels: Points | Stills | None = None
    amplitude: bool = False


@dataclass(frozen=True)
class Job:
    """A recording to be tracked with a seed.

    side: of SIDES.  overrides: of the tracker.  peer: the Python of MediaPipe, which says what it
    sees in the same frames, in turn with the tracker; None: without it.
    """

    source: Source
    seed: int
    side: str = "told"
    overrides: tuple[str, ...] = ()
    peer: str | None = None


def sources(paths: Sequence[str | Path], labels: Sequence[str | Path] = ()) -> list[Source]:
    """The recordings with truth or labels among files and in folders, in the order of their names.

    Raises ToftrackError for what is no recording, a folder without any of them, a file without
    truth that no labels fit, labels that fit none, and two recordings of one name.
    """
    known = [read_labels(path) for path in labels]
    found: list[Source] = []
    for path in (Path(path).expanduser() for path in paths):
        files = sorted(path.glob("*.npz")) if path.is_dir() else [path]
        mine = [source for source in (_source(file, known) for file in files) if source]
        if not mine:
            what = f"'{path}' {'holds no recording' if path.is_dir() else 'is no recording'}"
            raise ToftrackError(
                f"{what} with truth (an .npz with 'joints_m') or labels that fit its images in "
                "size and, for stills, in number; give one that has, or labels of its images with "
                "--labels FILE, which `toftrack label RECORDING` makes"
            )
        found += mine
    for one in known:
        if not any(source.labels is one for source in found):
            raise ToftrackError(
                f"the labels '{one.path}' are of images of {one.size[0]} x {one.size[1]} pixels, "
                "which no recording without truth has; give the recording that was labelled"
            )
    names = [source.name for source in found]
    for name in names:
        if names.count(name) > 1:
            raise ToftrackError(
                f"two recordings are called '{name}', the folder's name and their own; rename one"
            )
    return found


def _source(file: Path, known: Sequence[Points | Stills]) -> Source | None:
    """None where there is neither truth nor labels."""
    with closing(read_recording(file)) as recording:
        name = f"{file.absolute().parent.name}/{file.stem}"
        count, size = len(recording), (recording.camera.width, recording.camera.height)
        if recording.truth is not None:
            amplitude = count > 0 and recording.image(0)[1] is not None
            return Source(file, name, count, amplitude=amplitude)
        fitting = [
            one
            for one in known
            if one.size == size and (isinstance(one, Points) or len(one.images) == count)
        ]
        if len(fitting) > 1:
            raise ToftrackError(
                f"'{fitting[0].path}' and '{fitting[1].path}' could both be the labels of "
                f"'{file}'; give one of them at a time"
            )
        return Source(file, name, count, fitting[0]) if fitting else None


def jobs(
    found: Sequence[Source],
    seeds: Sequence[int],
    side: str,
    overrides: Sequence[str],
    peer: str | None = None,
) -> list[Job]:
    """Every recording with every seed; the peer, which has none, beside the first. Raises
    ToftrackError for a recording without amplitude, where there is a peer."""
    for one in found if peer is not None else ():
        if not one.amplitude:
            raise ToftrackError(
                f"'{one.path}' has no amplitude image, which --peer {PEER} needs; leave "
                "the recording out, or --peer"
            )
    given = tuple(overrides)
    return [
        Job(one, seed, side, given, peer if seed == seeds[0] else None)
        for one in found
        for seed in seeds
    ]


def run_jobs(todo: Sequence[Job], workers: int, words: str = "") -> Iterator[list[Row]]:
    """Run all of them; the rows of each, in any order. Raises ToftrackError, also of a worker."""
    total = sum(job.source.frames for job in todo)
    here = workers == 1 or len(todo) < 2
    finished = ((job, rows_of_job(job)) for job in todo) if here else _in_processes(todo, workers)
    with tqdm(
        total=total, unit=" frames", file=sys.stderr, desc=words or None, disable=None
    ) as bar:
        for job, rows in finished:
            bar.set_postfix_str(f"{job.source.name}, seed {job.seed}", refresh=False)
            yield rows
            bar.update(job.source.frames)


def _in_processes(todo: Sequence[Job], workers: int) -> Iterator[tuple[Job, list[Row]]]:
    # Fresh processes: what torch and numba have started does not survive a fork.
    context = multiprocessing.get_context("spawn")
    count = min(workers, len(todo))
    pool = ProcessPoolExecutor(count, context, initializer=_begin_worker)
    try:
        running = {pool.submit(rows_of_job, job): job for job in todo}
        for future in as_completed(running):
            yield running[future], future.result()
    except BrokenProcessPool as error:
        raise ToftrackError(
            f"one of the {count} processes was ended from outside, perhaps for want of memory; "
            "give fewer --workers"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process says when to end
    torch.set_num_threads(1)  # a core each


def rows_of_job(job: Job) -> list[Row]:
    """Track a recording: one row, or one for each labelled image."""
    with Replay(job.source.path) as device:
        labels = job.source.labels
        if labels is None:
            return _true_rows(job, device)
        if isinstance(labels, Stills):
            rows = _stills(job, device, labels)
        else:
            rows = _points(job, device, labels)
        return [
            {"recording": f"{job.source.name}#{number:04d}", "seed": job.seed, **figures}
            for number, figures in rows
        ]


def _true_rows(job: Job, device: Replay) -> list[Row]:
    """A row of the tracker, and one of the peer, if there is one."""
    truth = device.truth
    assert truth is not None
    if job.side == "told" and not truth.side:
        raise ToftrackError(
            f"'{job.source.path}' does not say whose hand it shows ('side' in its metadata), "
            "so --side told cannot know; give --side auto"
        )
    reported, others = _tracked(device, job, truth.side)
    rows = [_row(job, device, truth, reported)]
    if others:
        rows.append({"method": PEER, **_row(job, device, truth, others)})
    return rows


def _row(job: Job, device: Replay, truth: Truth, reported: Reported) -> Row:
    track = estimates_of(reported, with_side=job.side == "auto")
    compute_s = np.array([frame[0].compute_s for frame in reported])
    found = measured(track, truth)
    about = device.metadata
    camera = about.get("camera")
    kind = camera.get("kind") if isinstance(camera, dict) else None
    size = f"{device.camera.width} x {device.camera.height}"
    length = about.get("hand_length_mm")
    length_mm = float(length) if isinstance(length, int | float) else None
    sensor = kind if isinstance(kind, str) else size
    return {
        "recording": job.source.name,
        "seed": job.seed,
        **row_figures(found, compute_s),
        "groups": group_counts(found.first, truth, sensor, length_mm),
    }


def _tracked(device: Replay, job: Job, side: str) -> tuple[Reported, Reported]:
    """What the tracker says of each frame, and what the peer, if there is one, says after it."""
    peer = None if job.peer is None else peer_process(job.peer)
    if peer is not None:
        peer.begin(device.camera, side if job.side == "told" else "")
    tracker = _tracker(job, side)
    reported: Reported = []
    others: Reported = []
    for frame in device:
        depth = device.camera.rectify(frame.depth, frame.radial)
        said = tracker.step(depth, device.camera.K, frame.index, frame.timestamp_s)
        reported.append(tuple(map(kept, said)))
        if peer is not None:
            assert frame.amplitude is not None
            others.append((peer.step(depth, frame.amplitude),))
    return reported, others


def kept(estimate: Estimate) -> SimpleNamespace:
    """What is measured of an estimate of a recording's frame, a tenth of it."""
    names = (*_FIELDS, *_SIDE_FIELDS, "compute_s")
    return SimpleNamespace(**{name: getattr(estimate, name) for name in names})


def estimates_of(reported: Reported, with_side: bool = False) -> Estimates:
    """What was said in T frames of each slot, by those fields of Estimates that the reported ones
    have, with the side where it was found out; with one slot without its axis."""
    names = (*_FIELDS, *(_SIDE_FIELDS if with_side else ()))

    def column(name: str) -> np.ndarray:
        values = np.array([[getattr(one, name) for one in frame] for frame in reported])
        return values[:, 0] if values.shape[1] == 1 else values

    return Estimates(**{name: column(name) for name in names if hasattr(reported[0][0], name)})


def _points(job: Job, device: Replay, labels: Points) -> Iterator[tuple[int, Row]]:
    reported, _ = _tracked(device, job, labels.side)
    track = estimates_of(reported)
    assert track.joint_ok is not None
    rows = point_rows(labels, track.joints_m, track.lost, track.joint_ok, device.camera.K)
    for number, figures in rows.items():
        yield number, {"kind": "points", **figures}


def _stills(job: Job, device: Replay, labels: Stills) -> Iterator[tuple[int, Row]]:
    for number, (frame, shown) in enumerate(zip(device, labels.images, strict=True)):
        depth = device.camera.rectify(frame.depth, frame.radial)
        tracker = _tracker(job, labels.side)
        for index in range(labels.shown_frames):
            (seen,) = tracker.step(depth, device.camera.K, index, index / device.fps)
        figures = still_row(seen.gesture, seen.lost, labels.called[shown])
        yield number, {"kind": "stills", "shown": shown, "gesture": seen.gesture, **figures}


def _tracker(job: Job, side: str) -> HandsTracker:
    """A fresh tracker; the model is the same for all of its configuration."""
    side = side if job.side == "told" else "auto"
    model, hands = _model(f"hand.side={side}", *job.overrides)
    return HandsTracker(model, job.seed, hands)


@functools.lru_cache(maxsize=2)
def _model(*overrides: str) -> tuple[FilterModel, int]:
    """The tracker's parts, which keep nothing, and how many hands are followed."""
    config = configuration(*overrides)
    with one_sentence():
        return build_model(config), config.get("hands", 1)
