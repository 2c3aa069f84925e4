"""What `toftrack track` does: build the parts, run the loop, write and report."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tqdm import tqdm

from toftrack.api import build_tracker
from toftrack.devices.base import Device
from toftrack.errors import ToftrackError
from toftrack.estimate import Estimate, confidence_words
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.advice import Watch
from toftrack.output.evaluation import metrics_table
from toftrack.output.results import ResultWriter
from toftrack.output.smoothing import OneEuro, smooth
from toftrack.output.stream import ReaderGoneError, Stream
from toftrack.programs import endings
from toftrack.programs.run_facts import ShapeFile, opening, run_metadata
from toftrack.tracking.conventions import in_all_conventions
from toftrack.tracking.tracker import Tracker
from toftrack.views.base import TrackedFrame, View


def track(config: DictConfig, device: Device) -> float:
    """Run a configuration to its end; returns the mean joint error in mm, else 1 - mean score.

    `device` is what `config.device` describes; it is opened and closed here. A request to end the
    program is obeyed between two frames; then everything is finished before it is passed on.
    """
    with hydra.utils.instantiate(config.stream) as stream:
        return _track(config, device, stream)


def _track(config: DictConfig, device: Device, stream: Stream) -> float:
    tracker = build_tracker(config)
    watch = Watch(float(config.segmentation.get("max_distance_m", math.inf)))
    try:
        return _run(config, device, tracker, stream, watch)
    finally:  # a live run that lost the hand ends by an interruption
        for sentence in watch.advice(tracker.shape.side):
            endings.say(f"note: {sentence}", sys.stderr)


def _run(
    config: DictConfig, device: Device, tracker: Tracker, stream: Stream, watch: Watch
) -> float:
    folder = Path(HydraConfig.get().runtime.output_dir)
    make = hydra.utils.instantiate
    parts = _Parts(tracker, stream, make(config.smooth), watch, ShapeFile(folder, tracker))
    ended: KeyboardInterrupt | None = None
    with device:
        metadata = run_metadata(config, device, tracker)
        print(opening(metadata, device), file=sys.stderr)
        # It is the first to write into the folder, which it refuses to share with another run.
        with ResultWriter(folder, metadata, JOINT_NAMES, device.truth) as results:
            make_view = make(config.view, _partial_=True)
            try:
                view: View
                with make_view(folder=folder, fps=device.fps, frames=device.frames) as view:
                    _follow(device, results, view, parts)
            except KeyboardInterrupt as end:
                ended = end
    summary = results.summary or {}
    if summary.get("frames"):
        endings.say(metrics_table(summary), sys.stdout)
        endings.say(_told_files(folder), sys.stdout)
    if ended is not None:
        raise ended
    if not summary.get("frames"):
        raise ToftrackError("the device delivered no frame; nothing was tracked")
    error = (summary.get("metrics") or {}).get("mean_mm")
    return float(error) if error is not None else 1.0 - float(summary["mean_score"])


@dataclass(frozen=True, eq=False)
class _Parts:
    """What the loop needs beside the device, the results and the view."""

    tracker: Tracker
    stream: Stream
    smoothing: OneEuro | None
    watch: Watch
    shape: ShapeFile


def _follow(device: Device, results: ResultWriter, view: View, parts: _Parts) -> None:
    """All frames, and the results' files; the view may stay after that."""
    try:
        _loop(device, results, view, parts)
    except ReaderGoneError as gone:
        print(f"{gone}: tracking ends here", file=sys.stderr)
    finally:
        with endings.not_now():
            try:
                parts.shape.save(last=True)
            finally:
                results.close()


def _loop(device: Device, results: ResultWriter, view: View, parts: _Parts) -> None:
    tracker, smoothing = parts.tracker, parts.smoothing
    smoothed = None
    progress = partial(tqdm, total=device.frames, unit=" frames", file=sys.stderr, mininterval=0.2)
    with progress() as bar:
        for frame in device:
            with endings.not_now():
                for command in view.commands():
                    tracker.restart(None if command == "restart" else command)
                depth = device.camera.rectify(frame.depth, frame.radial)
                shape = tracker.shape
                estimate = tracker.step(depth, device.camera.K, frame.index, frame.timestamp_s)
                parts.watch.see(estimate, depth, tracker.insight)
                smoothed, calm = smooth(smoothing, smoothed, estimate, shape)
                if calm is not estimate:
                    size_px = depth.shape[1], depth.shape[0]
                    calm = in_all_conventions(calm, shape, device.camera.K, size_px)
                if smoothing is not None and smoothing.results:
                    estimate = calm
                results.append(estimate)
                parts.shape.save()
                parts.stream.send(calm)
                view.show(
                    TrackedFrame(frame, depth, device.camera, estimate, shape, tracker.insight)
                )
                bar.update()
                bar.set_postfix_str(_progress_words(estimate), refresh=False)


def _progress_words(estimate: Estimate) -> str:
    facts = (f"score {estimate.score:.2f}", confidence_words(estimate.confidence))
    return ", ".join(filter(None, (*facts, estimate.state_name)))


def _told_files(folder: Path) -> str:
    written = sorted(path for path in folder.iterdir() if path.is_file() and path.suffix != ".log")
    return "\n".join([f"results: {folder}", *(f"  {path}" for path in written)])
