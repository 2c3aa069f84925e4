"""What `toftrack track` does: build the parts, run the loop, write and report."""

from __future__ import annotations

import logging
import math
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from toftrack.api import build_hands_tracker
from toftrack.compute.quality import Pace
from toftrack.devices.base import Device
from toftrack.errors import ToftrackError, reported_errors
from toftrack.estimate import Estimate, confidence_words, is_vacant
from toftrack.hand.conventions import in_all_conventions
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.advice import Watch
from toftrack.output.results import RealTime, ResultWriter
from toftrack.output.smoothing import OneEuro, SmoothState, smooth
from toftrack.output.stream import ReaderGoneError, Stream
from toftrack.output.summary import metrics_line, metrics_table, shape_file
from toftrack.programs import shutdown
from toftrack.programs.command_line import in_sweep, job_words
from toftrack.recordings.recorder import Recorder
from toftrack.tracking.tracker import HandsTracker
from toftrack.views.base import TrackedFrame, TrackedHand, View

_log = logging.getLogger(__name__)


def track(config: DictConfig, device: Device) -> float:
    """Run a configuration to its end; returns the mean joint error in mm, else 1 - mean score.

    `device` is what `config.device` describes; it is opened and closed here. A request to end the
    program is obeyed between two frames; then everything is finished before it is passed on.
    """
    # Both tell at once what is wrong with them.
    with _recorder(config, device) as recorder, hydra.utils.instantiate(config.stream) as stream:
        parts = _parts(config, device, stream, recorder)
        try:
            return _run(config, device, parts)
        finally:  # a live run that lost the hand ends by an interruption
            for sentence in _notes(parts):
                _note(sentence)


def _recorder(config: DictConfig, device: Device) -> AbstractContextManager[Recorder | None]:
    """What keeps the frames; None where nothing is to be kept."""
    # A configuration of one's own may do without.
    if config.get("record") is None:
        return nullcontext()
    limit_gb = config.record_limit_gb
    return Recorder(str(config.record), device, limit_gb, tell=_log.warning)


def _parts(config: DictConfig, device: Device, stream: Stream, recorder: Recorder | None) -> _Parts:
    tracker = build_hands_tracker(config)
    if not device.live:  # recordings have no budget, so that they stay reproducible
        tracker.time.pace = Pace()
    elif tracker.time.pace.budget_s is None:
        tracker.time.pace = Pace(1 / device.fps)
    reach_m = float(config.segmentation.get("max_distance_m", math.inf))
    return _Parts(
        tracker,
        stream,
        smoothing=hydra.utils.instantiate(config.smooth),
        watch=Watch(reach_m, len(tracker.states)),
        shapes=ShapeFiles(Path(HydraConfig.get().runtime.output_dir), tracker),
        realtime=RealTime(device.fps),
        recorder=recorder,
    )


def _notes(parts: _Parts) -> tuple[str, ...]:
    """What is to be said of a run at its end."""
    dropped = tuple(filter(None, (parts.realtime.words(),)))
    # Hands are lost, too, where most frames are dropped.
    if parts.realtime.too_slow:
        return dropped
    return dropped + parts.watch.advice(_given_side(parts.tracker))


def _given_side(tracker: HandsTracker) -> str | None:
    """Of the only hand, by the configuration or in a view; None where it is detected."""
    return tracker.state.told if len(tracker.states) == 1 else None


def _run(config: DictConfig, device: Device, parts: _Parts) -> float:
    folder = Path(HydraConfig.get().runtime.output_dir)
    ended: KeyboardInterrupt | None = None
    if device.live:
        parts.tracker.prepare()  # a camera does not wait for what is loaded at the first frame
    with device:
        metadata = run_metadata(config, device, parts.tracker)
        if not in_sweep():
            print(opening(metadata, device), file=sys.stderr)
        # It is the first to write into the folder, which it refuses to share with another run.
        with ResultWriter(folder, metadata, JOINT_NAMES, device.truth) as results:
            make_view = hydra.utils.instantiate(config.view, _partial_=True)
            try:
                view: View
                with make_view(folder=folder, fps=device.fps, frames=device.frames) as view:
                    _follow(device, results, view, parts)
            except KeyboardInterrupt as end:
                ended = end
    summary = results.summary or {}
    _report(summary, folder, parts.recorder)
    said = metadata["device"].get("doubts", ())  # by the device itself
    for doubt in summary.get("doubts", ()):
        if doubt not in said:
            _note(doubt)
    if ended is not None:
        raise ended
    if not summary.get("frames"):
        raise ToftrackError("the device delivered no frame; nothing was tracked")
    error = (summary.get("metrics") or {}).get("mean_mm")
    return float(error) if error is not None else 1.0 - float(summary["mean_score"] or 0.0)


def _report(summary: dict[str, Any], folder: Path, recorder: Recorder | None) -> None:
    """A table and the files; of a sweep's job one line."""
    if in_sweep():
        line = metrics_line(summary) if summary.get("frames") else "no frames"
        shutdown.say(f"{job_words()}: {line}; {folder}", sys.stdout)
        return
    if summary.get("frames"):
        shutdown.say(metrics_table(summary), sys.stdout)
        shutdown.say(_reported_files(folder), sys.stdout)
    if recorder is not None and recorder.words():
        shutdown.say(f"  {recorder.words()}", sys.stdout)


def _note(sentence: str) -> None:
    """What speaks against the run or its result; of a sweep summary.json tells it."""
    if not in_sweep():
        shutdown.say(f"note: {sentence}", sys.stderr)


@dataclass(eq=False)
class _Parts:
    """What the loop needs beside the device, the results and the view."""

    tracker: HandsTracker
    stream: Stream
    smoothing: OneEuro | None
    watch: Watch
    shapes: ShapeFiles
    realtime: RealTime
    """As of the newest frame; of a recording nothing."""
    recorder: Recorder | None


def _follow(device: Device, results: ResultWriter, view: View, parts: _Parts) -> None:
    """All frames, and the results' files; the view may stay after that."""
    try:
        _loop(device, results, view, parts)
    except ReaderGoneError as gone:
        print(f"{gone}: tracking ends here", file=sys.stderr)
    finally:
        with shutdown.not_now():
            results.realtime = parts.realtime if device.live else None
            results.apparent_m = parts.watch.apparent_m()
            try:
                parts.shapes.save(last=True)
            finally:
                results.close()
                if parts.recorder is not None:
                    parts.recorder.close()


def _loop(device: Device, results: ResultWriter, view: View, parts: _Parts) -> None:
    tracker, smoothing = parts.tracker, parts.smoothing
    smoothed: tuple[SmoothState | None, ...] = (None,) * len(tracker.states)
    progress = partial(tqdm, total=device.frames, unit=" frames", file=sys.stderr, mininterval=0.2)
    if in_sweep():  # gone afterwards, and none at all where nobody looks
        progress = partial(progress, leave=False, disable=None)
    with progress() as bar:
        for frame in device:
            began_s = time.perf_counter()
            with shutdown.not_now():
                if parts.recorder is not None:  # first: whatever it may do to the tracker
                    parts.recorder.put(frame, wait=not device.live)
                for command in view.commands():
                    tracker.restart(None if command == "restart" else command)
                depth = device.camera.rectify(frame.depth, frame.radial)
                before = tracker.shapes
                estimates = tracker.step(
                    depth, device.camera.K, frame.index, frame.timestamp_s, began_s
                )
                shapes = tuple(map(_of_estimate, before, estimates))
                parts.watch.see(estimates, depth, tracker.insights)
                every = zip(smoothed, estimates, shapes, strict=True)
                made = [smooth(smoothing, *one) for one in every]
                smoothed = tuple(one[0] for one in made)
                calm = tuple(
                    _in_all_conventions(one[1], found, shape, device.camera.K, depth)
                    for one, found, shape in zip(made, estimates, shapes, strict=True)
                )
                if smoothing is not None and smoothing.results:
                    estimates = calm
                results.append(estimates)
                parts.shapes.save()
                parts.stream.send(calm)
                hands = tuple(map(TrackedHand, estimates, shapes, tracker.insights))
                given = _given_side(tracker)
                advice = parts.watch.advice(given, recent=True)
                view.show(
                    TrackedFrame(frame, depth, device.camera, hands, given is not None, advice)
                )
                bar.update()
                if device.live:
                    took_s, reduced = tracker.time.took_s(), tracker.time.reduced
                    parts.realtime.add(frame.timestamp_s, took_s, reduced, device.dropped)
                bar.set_postfix_str(_progress_words(estimates, parts), refresh=False)


def _in_all_conventions(
    smoothed: Estimate, found: Estimate, shape: HandShape, k: np.ndarray, depth_m: np.ndarray
) -> Estimate:
    """What follows from the smoothed joints, too; nothing to do where nothing was smoothed."""
    if smoothed is found:
        return found
    return in_all_conventions(smoothed, shape, k, (depth_m.shape[1], depth_m.shape[0]))


def _of_estimate(shape: HandShape, estimate: Estimate) -> HandShape:
    """The hand that a slot had, or, where it turned out to be the other one, that."""
    return shape if estimate.side in ("", shape.side) else shape.of_side(estimate.side)


def _progress_words(estimates: Sequence[Estimate], parts: _Parts) -> str:
    dropped = f", {parts.realtime.dropped} dropped" if parts.realtime.dropped else ""
    pace = dropped + (", reduced effort" if parts.tracker.time.pace.reduced else "")
    if len(estimates) == 1:
        return f"score {estimates[0].score:.2f}, {_sure_words(estimates[0])}{pace}"
    there = [estimate for estimate in estimates if not is_vacant(estimate)]
    return (" | ".join(f"{one.side} {_sure_words(one)}" for one in there) or "no hand") + pace


def _sure_words(estimate: Estimate) -> str:
    return ", ".join(filter(None, (confidence_words(estimate.confidence), estimate.state_name)))


def _reported_files(folder: Path) -> str:
    written = sorted(path for path in folder.iterdir() if path.is_file() and path.suffix != ".log")
    return "\n".join([f"results: {folder}", *(f"  {path}" for path in written)])


_APART_S = 1.0


def run_metadata(config: DictConfig, device: Device, tracker: HandsTracker) -> dict[str, Any]:
    """The metadata of run.json and track.npz, JSON-able.

    The hand's shape is the first slot's at the start, its side 'auto' where none was given.
    """
    camera, shape = device.camera, tracker.shapes[0]
    return {
        "toftrack": version("toftrack"),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "seed": config.seed,
        "compute": str(tracker.device),
        "renderer": tracker.scorer.name,
        "device": device.description,
        "pose_space": {"kind": tracker.space.kind, "dims": tracker.space.dims},
        "hand_shape": {
            "side": configured_side(config, shape.side) or "auto",
            "fitted": tracker.model.fits,
            "thickness": shape.thickness,
            "hand_length_m": shape.hand_length_m,
            "bone_lengths_m": shape.bone_lengths_m.tolist(),
        },
        "camera": {
            "K": camera.K.tolist(),
            "width": camera.width,
            "height": camera.height,
            "distortion": camera.distortion.tolist(),
            "lens": camera.lens,
            "depth_polynomial": list(camera.depth_polynomial),
        },
        "config": OmegaConf.to_container(config, resolve=True),
    }


def configured_side(config: Mapping[str, Any], side: str) -> str | None:
    """The side that was given; None where either hand may come, or several.

    config: of the run.  side: of the hand that is looked for.
    """
    configured = config.get("hands", 1) == 1 and (config.get("hand") or {}).get("side") != "auto"
    return side if configured else None


def opening(metadata: dict[str, Any], device: Device) -> str:
    """What is tracked, how many hands, which side, which size: one line to begin with."""
    about, shape, config = metadata["device"], metadata["hand_shape"], metadata["config"]
    source = about.get("recording") or about.get("device")
    count = "live" if device.frames is None else f"{device.frames} frames"
    side = shape["side"]
    length_mm = 1e3 * float(shape["hand_length_m"])
    fitted = "to be fitted from" if shape["fitted"] else "of"
    if (hands := config.get("hands", 1)) > 1:
        what = f"up to {hands} hands, their lengths"
    elif side == "auto":
        what = "a hand of either side (hand.side=right or left to say which), its length"
    else:
        other = "left" if side == "right" else "right"
        what = f"a {side} hand (hand.side={other} for the other), its length"
    return f"tracking {source} ({count}): {what} {fitted} {length_mm:.0f} mm"


class ShapeFiles:
    """The hands' files of a run, hand_shape.json, of a second slot hand_shape_2.json and so on.

    They are there from the start on and follow what is fitted. Between the first and the last time
    they are a second old at most: they serve runs that are killed.
    """

    def __init__(self, folder: Path, tracker: HandsTracker) -> None:
        self._tracker, count = tracker, len(tracker.states)
        self._paths = [folder / shape_file(slot) for slot in range(count)]
        self._saved: list[HandShape | None] = [None] * count
        self._saved_s = [-math.inf] * count

    def save(self, last: bool = False) -> None:
        """Write the present hands, where they are others than were written.

        Raises ToftrackError when that is not possible; before the last time, it may be later.
        """
        now_s = time.monotonic()
        for slot, (path, shape) in enumerate(zip(self._paths, self._tracker.fitted, strict=True)):
            due = last or now_s > self._saved_s[slot] + _APART_S
            if shape is self._saved[slot] or not due:
                continue
            self._saved_s[slot] = now_s
            remedy = "make room, or choose another folder with hydra.run.dir=DIR"
            reported = reported_errors(f"'{path}' cannot be written", remedy)
            with reported if last else suppress(OSError):
                shape.to("cpu").save(path)
                self._saved[slot] = shape
