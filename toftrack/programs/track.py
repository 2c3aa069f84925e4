"""What `toftrack track` does: build the parts, run the loop, write and report."""

from __future__ import annotations

import logging
import math
import platform
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from toftrack.api import build_hands_tracker
from toftrack.compute.quality import Pace
from toftrack.devices.base import Device, frames_of
from toftrack.errors import ToftrackError, reported_errors
from toftrack.frames.estimate import Estimate, confidence_words, is_vacant
from toftrack.frames.frame import Frame
from toftrack.hand.conventions import in_all_conventions
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.advice import Watch
from toftrack.output.results import RealTime, ResultWriter
from toftrack.output.smoothing import OneEuro, SmoothState, smooth
from toftrack.output.stream import ReaderGoneError, Stream
from toftrack.output.summary import metrics_line, metrics_table, shape_file
from toftrack.programs import shutdown
from toftrack.programs.command_line import in_sweep, job_words, note
from toftrack.recordings.recorder import Recorder
from toftrack.render.likelihood import FMeasure
from toftrack.tracking.paper import PaperModel
from toftrack.tracking.tracker import HandsTracker
from toftrack.views.base import TrackedFrame, TrackedHand, View

_log = logging.getLogger(__name__)
_SHAPES_APART_S = 1.0


def track(config: DictConfig, device: Device) -> float:
    """Run a configuration to its end; returns the mean joint error in mm, of the frames in
    the pose space or, where there is none, of all, else 1 - mean score.

    `device` is what `config.device` describes; it is opened and closed here. A request to end the
    program is obeyed between two frames; then everything is finished before it is passed on.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    with prepared_run(config, device) as run:
        try:
            return _track(config, folder, run)
        finally:  # a live run that lost the hand ends by an interruption
            for sentence in run.notes():
                note(sentence)


@contextmanager
def prepared_run(config: DictConfig, device: Device) -> Iterator[Run]:
    """What works in the loop of a configuration; `device` is what it describes, not yet open."""
    recording: AbstractContextManager[Recorder | None] = nullcontext()
    if config.get("record") is not None:  # a configuration of one's own may do without
        limit_gb = config.record_limit_gb
        recording = closing(Recorder(str(config.record), device, limit_gb, tell=_log.warning))
    # Both tell at once what is wrong with them.
    with recording as recorder, instantiate(config.stream) as stream:
        tracker = build_hands_tracker(config)
        if not device.live:  # recordings have no budget, so that they stay reproducible
            tracker.time.pace = Pace()
        elif tracker.time.pace.budget_s is None:
            tracker.time.pace = Pace(1 / device.fps)
        reach_m = float(config.segmentation.get("max_distance_m", math.inf))
        run = Run(
            device,
            tracker,
            recorder,
            stream,
            smoothing=instantiate(config.smooth),
            watch=Watch(reach_m, len(tracker.states)),
            realtime=RealTime(device.fps),
            smoothed=[None] * len(tracker.states),
        )
        if device.live:
            tracker.prepare()  # a camera does not wait for what is loaded at the first frame
        yield run


def _track(config: DictConfig, folder: Path, run: Run) -> float:
    device, tracker = run.device, run.tracker
    ended: KeyboardInterrupt | None = None
    results: ResultWriter | None = None
    with device:
        metadata = run_metadata(config, device, tracker)
        earlier = _written(folder)
        if not in_sweep():
            print(_opening(metadata, device), file=sys.stderr)
        make_view = instantiate(config.view, _partial_=True)
        try:
            with (
                # It may not come up, as where its port is taken, and writes nothing by then.
                make_view(folder=folder, fps=device.fps, frames=device.frames) as view,
                # The first to write into the folder, which it refuses to share with another run.
                ResultWriter(folder, metadata, JOINT_NAMES, device.truth) as results,
            ):
                run.follow(results, view, folder)
        except KeyboardInterrupt as end:
            ended = end
    summary = results and results.summary or {}
    _report(summary, folder, earlier, run.recorder)
    said = metadata["device"].get("doubts", ())  # by the device itself
    for doubt in summary.get("doubts", ()):
        if doubt not in said:
            note(doubt)
    threshold, score = config.lost.get("score"), summary.get("mean_score")
    if None not in (threshold, score) and 2 * summary["lost_frames"] > summary["frames"]:
        note(
            f"the mean score is {score:.2f}, and a frame below lost.score={threshold:g}, made for"
            " the F-measure, is lost; lower that if the picture shows a hand that is followed"
        )
    if ended is not None:
        raise ended
    if not summary.get("frames"):
        raise ToftrackError("the device delivered no frame; nothing was tracked")
    metrics = summary.get("metrics") or {}
    error = metrics.get("mean_mm") or (metrics.get("trust") or {}).get("mean_all_mm")
    return float(error) if error is not None else 1.0 - float(summary["mean_score"] or 0.0)


@dataclass(eq=False)
class Run:
    """The loop over all frames, and what works in it."""

    device: Device
    tracker: HandsTracker
    recorder: Recorder | None
    stream: Stream
    smoothing: OneEuro | None
    watch: Watch
    realtime: RealTime
    """As of the newest frame; of a recording nothing."""
    smoothed: list[SmoothState | None]

    def notes(self) -> tuple[str, ...]:
        """What is to be said of the run at its end."""
        dropped = tuple(filter(None, (self.realtime.words(),)))
        about = self.device.description
        if dropped and about.get("realtime") and not about.get("repeat"):
            dropped += (
                "the first frames take longest, and are a large part of a short recording;"
                " device.repeat=true plays it again and again, device.realtime=false drops none",
            )
        # Hands are lost, too, where most frames are dropped.
        advice = () if self.realtime.too_slow else self.watch.advice(self._told())
        model = self.tracker.model
        if isinstance(model, PaperModel) and not isinstance(model.likelihood, FMeasure):
            advice = advice[:1]  # rather than the hand, lost.score is wrong, which is said
        if advice[1:] and (doubts := self.device.description.get("doubts")):
            # What there is to try may contradict it: hold nearer what is of another unit.
            advised = (f"If that is not the cause: {more}" for more in advice[1:])
            advice = advice[0], f"First look into this: {doubts[0]}", *advised
        return dropped + advice

    def follow(self, results: ResultWriter, view: View, folder: Path) -> None:
        """All frames, and the results' files; the view may stay after that."""
        shapes = _ShapeFiles(folder, self.tracker)

        def keep(estimates: tuple[Estimate, ...]) -> None:
            results.append(estimates)
            shapes.save()

        results.complete = False
        try:
            bar = tqdm(
                total=self.device.frames,
                unit=" frames",
                file=sys.stderr,
                mininterval=0.2,
                disable=None,  # in a log, which would keep every state of it
                leave=not in_sweep(),
            )
            above: AbstractContextManager[None] = nullcontext()
            if not bar.disable:
                # In a notebook, which shows no bar, its import warns of ipywidgets.
                from tqdm.contrib.logging import logging_redirect_tqdm

                above = logging_redirect_tqdm()  # on lines of their own
            with bar, above:
                for frame in frames_of(self.device):
                    began_s = time.perf_counter()
                    with shutdown.not_now():
                        tracked, _ = self.frame(frame, began_s, view, keep)
                        bar.update()
                        bar.set_postfix_str(self._progress(tracked.estimates), refresh=False)
            results.complete = True
        except ReaderGoneError as gone:
            print(f"{gone}: tracking ends here", file=sys.stderr)
        finally:
            with shutdown.not_now():
                results.realtime = self.realtime if self.device.live else None
                results.apparent_m = self.watch.apparent_m()
                try:
                    shapes.save(last=True)
                finally:
                    results.close()
                    if self.recorder is not None:
                        self.recorder.close()

    def frame(
        self,
        frame: Frame,
        began_s: float,
        view: View,
        keep: Callable[[tuple[Estimate, ...]], None] = lambda estimates: None,
    ) -> tuple[TrackedFrame, tuple[Estimate, ...]]:
        """Track a frame, keep, send and show it; returns it, and the estimates as they are sent."""
        device, tracker = self.device, self.tracker
        if self.recorder is not None:  # first: whatever it may do to the tracker
            self.recorder.put(frame, wait=not device.live)
        for command in view.commands():
            tracker.restart(None if command == "restart" else command)
        depth = device.camera.rectify(frame.depth, frame.radial)
        before = tracker.shapes
        estimates = tracker.step(depth, device.camera.K, frame.index, frame.timestamp_s, began_s)
        # The hand that a slot had, or, where it turned out to be the other one, that.
        shapes = tuple(
            shape if one.side in ("", shape.side) else shape.of_side(one.side)
            for shape, one in zip(before, estimates, strict=True)
        )
        self.watch.see(estimates, depth, tracker.insights)
        calm = tuple(self._calm(estimates, shapes, depth))
        if self.smoothing is not None and self.smoothing.results:
            estimates = calm
        keep(estimates)
        self.stream.send(calm)
        hands = tuple(map(TrackedHand, estimates, shapes, tracker.insights))
        told = self._told()
        advice = self.watch.advice(told, recent=True)
        tracked = TrackedFrame(frame, depth, device.camera, hands, told, advice, device.dropped)
        view.show(tracked)
        if device.live:
            took_s, reduced = tracker.time.took_s(), tracker.time.reduced
            self.realtime.add(frame.timestamp_s, took_s, reduced, device.dropped)
        return tracked, calm

    def _calm(
        self, estimates: tuple[Estimate, ...], shapes: tuple[HandShape, ...], depth_m: np.ndarray
    ) -> Iterator[Estimate]:
        """The estimates smoothed, and what follows from smoothed joints, too."""
        size = depth_m.shape[1], depth_m.shape[0]
        for slot, (found, shape) in enumerate(zip(estimates, shapes, strict=True)):
            self.smoothed[slot], calm = smooth(self.smoothing, self.smoothed[slot], found, shape)
            if calm is not found:
                calm = in_all_conventions(calm, shape, self.device.camera.K, size)
            yield calm

    def _told(self) -> str | None:
        """The only hand's side, by the configuration or in a view; None where it is detected."""
        return self.tracker.state.told if len(self.tracker.states) == 1 else None

    def _progress(self, estimates: tuple[Estimate, ...]) -> str:
        pace = f", {self.realtime.dropped} dropped" if self.realtime.dropped else ""
        pace += ", reduced effort" if self.tracker.time.pace.reduced else ""
        if len(estimates) == 1:
            return f"score {estimates[0].score:.2f}, {_sure_words(estimates[0])}{pace}"
        there = [f"{one.side} {_sure_words(one)}" for one in estimates if not is_vacant(one)]
        return (" | ".join(there) or "no hand") + pace


def _sure_words(estimate: Estimate) -> str:
    return ", ".join(filter(None, (confidence_words(estimate.confidence), estimate.state_name)))


def _written(folder: Path) -> set[tuple[Path, int]]:
    """The files in a folder, each with when it was written."""
    return {(path, path.stat().st_mtime_ns) for path in folder.glob("*") if path.is_file()}


def _report(
    summary: dict[str, Any], folder: Path, earlier: set[tuple[Path, int]], recorder: Recorder | None
) -> None:
    """A table and the files that are not as earlier; of a sweep's job one line."""
    if in_sweep():
        line = metrics_line(summary) if summary.get("frames") else "no frames"
        shutdown.say(f"{job_words()}: {line}; {folder}", sys.stdout)
        return
    if summary.get("frames"):
        files = sorted(path for path, _ in _written(folder) - earlier)
        lines = [f"  {path}" for path in files if path.suffix != ".log"]
        shutdown.say(metrics_table(summary), sys.stdout)
        shutdown.say("\n".join([f"results: {folder}", *lines]), sys.stdout)
    if recorder is not None and recorder.words():
        shutdown.say(f"  {recorder.words()}", sys.stdout)


def run_metadata(config: DictConfig, device: Device, tracker: HandsTracker) -> dict[str, Any]:
    """Of run.json and track.npz, JSON-able.

    The hand's shape is the first slot's at the start, its side 'auto' where either hand may come.
    """
    camera, shape = device.camera, tracker.shapes[0]
    told = config.get("hands", 1) == 1 and (config.get("hand") or {}).get("side") != "auto"
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
            "side": shape.side if told else "auto",
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
            "depth_polynomial_range_m": list(camera.depth_polynomial_range_m),
        },
        "config": OmegaConf.to_container(config, resolve=True),
    }


def _opening(metadata: dict[str, Any], device: Device) -> str:
    """What is tracked, how many hands, which side, which size: one line to begin with."""
    about, shape, config = metadata["device"], metadata["hand_shape"], metadata["config"]
    source = about.get("recording") or about.get("device")
    count = "live" if device.live else "until it ends"
    count = count if device.frames is None else f"{device.frames} frames"
    if (hands := config.get("hands", 1)) > 1:
        what = f"up to {hands} hands, their lengths"
    elif (side := shape["side"]) == "auto":
        what = "a hand of either side (hand.side=right or left says which), its length"
    else:
        other = "left" if side == "right" else "right"
        what = f"a {side} hand (hand.side={other} for the other), its length"
    fitted = "to be fitted, beginning with" if shape["fitted"] else "of"
    return f"tracking {source} ({count}): {what} {fitted} {1e3 * shape['hand_length_m']:.0f} mm"


class _ShapeFiles:
    """The hands' files of a run, hand_shape.json, of a second slot hand_shape_2.json and so on.

    They are there from the start on and follow what is fitted. Of several tracks in a slot the hand
    stays whose fit rests on most poses: that of a track which begins anew is a guess. Between the
    first and the last time they are a second old at most: they serve runs that are killed.
    """

    def __init__(self, folder: Path, tracker: HandsTracker) -> None:
        self._tracker, count = tracker, len(tracker.states)
        self._paths = [folder / shape_file(slot) for slot in range(count)]
        self._surest = [(-1, shape) for shape in tracker.fitted]
        """The number of a track, and its hand."""
        self._saved: list[HandShape | None] = [None] * count
        self._saved_s = [-math.inf] * count

    def save(self, last: bool = False) -> None:
        """Write the present hands, where they are others than were written.

        Raises ToftrackError when that is not possible; before the last time, it may be later.
        """
        now_s = time.monotonic()
        hands = zip(self._paths, self._tracker.states, self._tracker.fitted, strict=True)
        for slot, (path, state, present) in enumerate(hands):
            track, shape = self._surest[slot]
            if state.track == track or _poses(present) >= _poses(shape):
                shape = present
                self._surest[slot] = state.track, present
            due = last or now_s > self._saved_s[slot] + _SHAPES_APART_S
            if shape is self._saved[slot] or not due:
                continue
            self._saved_s[slot] = now_s
            remedy = "make room, or choose another folder with hydra.run.dir=DIR"
            reported = reported_errors(f"'{path}' cannot be written", remedy)
            with reported if last else suppress(OSError):
                shape.to("cpu").save(path)
                self._saved[slot] = shape


def _poses(shape: HandShape) -> float:
    """How many poses the fit of a hand rests on; 0 where it was not fitted."""
    return 0.0 if shape.fitted is None else shape.fitted.poses
