"""What `python track.py` does: build the parts, run the loop, write and report."""

from __future__ import annotations

import math
import platform
import sys
from functools import partial
from importlib.metadata import version
from pathlib import Path

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
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
from toftrack.tracking.tracker import Tracker
from toftrack.views.base import TrackedFrame, View


def track(config: DictConfig, device: Device) -> float:
    """Run a configuration to its end; returns the mean joint error in mm, else 1 - mean score.

    `device` is what `config.device` describes; it is opened and closed here.
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
            print(f"note: {sentence}", file=sys.stderr)


def _run(
    config: DictConfig, device: Device, tracker: Tracker, stream: Stream, watch: Watch
) -> float:
    folder = Path(HydraConfig.get().runtime.output_dir)
    make = hydra.utils.instantiate
    smoothing: OneEuro | None = make(config.smooth)
    with device:
        make_view = make(config.view, _partial_=True)
        metadata = _metadata(config, device, tracker)
        view: View
        with make_view(folder=folder, fps=device.fps, frames=device.frames) as view:
            with ResultWriter(folder, metadata, JOINT_NAMES, device.truth) as results:
                try:
                    _loop(device, tracker, results, view, stream, smoothing, watch)
                except ReaderGoneError as gone:
                    print(f"{gone}: tracking ends here", file=sys.stderr)
                finally:
                    tracker.fitted.to("cpu").save(folder / "hand_shape.json")
    summary = results.summary or {}
    if not summary.get("frames"):
        raise ToftrackError("the device delivered no frame; nothing was tracked")
    print(metrics_table(summary))
    print(f"results: {folder}")
    for path in sorted(folder.iterdir()):
        if path.is_file() and path.suffix != ".log":
            print(f"  {path}")
    error = (summary.get("metrics") or {}).get("mean_mm")
    return float(error) if error is not None else 1.0 - float(summary["mean_score"])


def _loop(
    device: Device,
    tracker: Tracker,
    results: ResultWriter,
    view: View,
    stream: Stream,
    smoothing: OneEuro | None,
    watch: Watch,
) -> None:
    smoothed = None
    progress = partial(tqdm, total=device.frames, unit=" frames", file=sys.stderr, mininterval=0.2)
    with progress() as bar:
        for frame in device:
            for command in view.commands():
                tracker.restart(None if command == "restart" else command)
            depth = device.camera.rectify(frame.depth, frame.radial)
            shape = tracker.shape
            estimate = tracker.step(depth, device.camera.K, frame.index, frame.timestamp_s)
            watch.see(estimate, depth, tracker.insight)
            smoothed, calm = smooth(smoothing, smoothed, estimate, shape)
            if smoothing is not None and smoothing.results:
                estimate = calm
            results.append(estimate)
            stream.send(calm)
            view.show(TrackedFrame(frame, depth, device.camera, estimate, shape, tracker.insight))
            bar.update()
            bar.set_postfix_str(_progress_words(estimate), refresh=False)


def _progress_words(estimate: Estimate) -> str:
    facts = (f"score {estimate.score:.2f}", confidence_words(estimate.confidence))
    return ", ".join(filter(None, (*facts, estimate.state_name)))


def _metadata(config: DictConfig, device: Device, tracker: Tracker) -> dict:
    camera, shape = device.camera, tracker.shape
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
            "side": shape.side,
            "thickness": shape.thickness,
            "hand_length_m": shape.hand_length_m,
            "bone_lengths_m": shape.bone_lengths_m.tolist(),
        },
        "camera": {
            "K": camera.K.tolist(),
            "width": camera.width,
            "height": camera.height,
            "distortion": camera.distortion.tolist(),
            "depth_polynomial": list(camera.depth_polynomial),
        },
        "config": OmegaConf.to_container(config, resolve=True),
    }
