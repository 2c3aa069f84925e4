"""How fast hypotheses are scored, frames tracked and latents decoded: `toftrack benchmark speed`.

All methods of a table are timed in turn within one process, so that what else the machine does
affects all of them alike. The hypotheses are spread around the true wrist of the packaged
recording's first frame, cropped around the hand. The baselines are timed on few particles only:

* stepping: the paper's own way (section 2.2), rays stepped in 5 mm to the quadric's crossing;
* naive: the closed form over whole images of all ellipsoids (ReferenceScorer).
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle
from typing import Any

import numpy as np
import torch
from hydra.utils import instantiate
from torch import Tensor

from toftrack.api import make_device, make_tracker
from toftrack.configuration.compose import configuration
from toftrack.errors import ToftrackError
from toftrack.evaluation.results import processor
from toftrack.frames.camera import Camera
from toftrack.hand.shape import default_hand_shape
from toftrack.pose_space.files import KINDS, fit_pose_space
from toftrack.recordings.store import open_source
from toftrack.render.reference import ReferenceScorer
from toftrack.render.scoring import Evidence, Scorer
from toftrack.tracking.backend import BACK_ENDS, make_scorer

PARTICLES = (100, 300, 1000, 3000, 10_000)
BASELINES = {"stepping": 3, "naive": 5}
"""The baselines and how often each is timed."""
CONFIGURATIONS: dict[str, tuple[str, ...]] = {"default": (), "paper": ("experiment=paper",)}
PARTS = (
    "rectification",
    "detector",
    "segmentation and evidence",
    "filter: scoring",
    "filter: rest",
    "refinement",
    "rest",
)
"""What a frame's time is spent on; of the networks, which have a thread, what is waited for."""
_SLOW_PARTICLES = 300
"""The baselines are not timed with more particles than this."""
_MOST_REPEATS = 200
_MARGIN_PX = 12
_LATENTS = 10_000
_FEWEST_FRAMES, _STARTS = 12, 6
_BODY_M, _WALL_M = 0.9, 1.5
"""From where on the packaged recording shows the body, and where the wall is."""
Row = dict[str, Any]
"""One line of a table, times in milliseconds; JSON-able.

table: "scoring" (from states to counts), "decoding" (from latents to angles) or "whole frame".
method: a back end or baseline, a pose space, or a configuration; ", start" says that the hand was
    looked for anew in every frame, ", searching" that moreover there was none, but the person and
    the room.
count: hypotheses, latents or particles.  pixels: of the image; None where there is none.
parts: of a frame, what is spent on each of PARTS.
"""


def _row(table: str, method: str, count: int, pixels: int | None, seconds: Sequence[float]) -> Row:
    return {
        "table": table,
        "method": method,
        "count": count,
        "pixels": pixels,
        "min_ms": 1e3 * min(seconds),
        "median_ms": 1e3 * statistics.median(seconds),
        "repeats": len(seconds),
        "parts": {},
    }


def interleaved(
    calls: Mapping[str, Callable[[], object]], seconds: float, device: torch.device
) -> dict[str, list[float]]:
    """Seconds of each call, timed in turn for so long each; slow ones have fewer repeats, in the
    first rounds."""

    def timed(call: Callable[[], object]) -> float:
        began = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter() - began

    repeats = {}
    for name, call in calls.items():
        repeats[name] = BASELINES.get(name, 0)
        if name not in BASELINES:
            timed(call)
            repeats[name] = min(_MOST_REPEATS, max(3, int(seconds / timed(call))))
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(max(repeats.values(), default=0)):
        for name, call in calls.items():
            if turn < repeats[name]:
                times[name].append(timed(call))
    return times


def sample_evidence() -> tuple[Evidence, Tensor]:
    """Evidence of the sample's first frame around the hand, and the true wrist (3,), metres."""
    config, sample = configuration("device=sample"), open_source("sample")
    assert sample.truth is not None
    depth = sample.image(0)[0]
    observation = instantiate(config.segmentation)(depth, sample.camera.K)
    evidence = instantiate(config.likelihood).evidence(observation)
    v, u = observation.hand.nonzero().unbind(1)
    left, top = max(int(u.min()) - _MARGIN_PX, 0), max(int(v.min()) - _MARGIN_PX, 0)
    right = min(int(u.max()) + _MARGIN_PX + 1, depth.shape[1])
    bottom = min(int(v.max()) + _MARGIN_PX + 1, depth.shape[0])
    wrist = torch.from_numpy(sample.truth.joints_m[0, 0])
    return evidence.cropped(left, top, right, bottom), wrist


def filter_states(n: int, wrist: Tensor) -> Tensor:
    """(N, 27) open palms at the wrist's position, spread by 1 cm and by 0.1 rad an angle."""
    generator = torch.Generator().manual_seed(0)
    states = torch.zeros(n, 27)
    states[:, :3] = wrist
    spread = torch.tensor([0.01] * 3 + [0.1] * 24)
    return states + spread * torch.randn(n, 27, generator=generator)


def score_times(
    particles: Sequence[int],
    seconds: float,
    device: torch.device,
    baselines: bool,
    notes: list[str],
) -> Iterator[Row]:
    """By the number of particles, the baselines at few of them; the notes get why a back end does
    not score on this device."""
    shape = default_hand_shape().to(device)
    chunk = 4 if device.type == "cpu" else 128  # hypotheses whose images suit the cache
    scorers: dict[str, Scorer] = {}
    for name in BASELINES if baselines else ():
        scorers[name] = ReferenceScorer(shape, chunk, name == "stepping")
    for name in BACK_ENDS:
        if name == "numba" and device.type == "cuda":
            continue  # it would measure the way to the CPU and back
        try:
            scorers[name] = make_scorer(name, shape, device)
        except ToftrackError as error:
            why = str(error).partition(";")[0]  # and not what a run is to do about it
            notes.append(f"note: {name} is not timed: {why}")
            print(notes[-1], flush=True)
    found, wrist = sample_evidence()
    evidence = found.to(device)
    for n in particles:
        states = filter_states(n, wrist).to(device)
        calls = {
            name: partial(scorer, states, evidence)
            for name, scorer in scorers.items()
            if name not in BASELINES or n <= _SLOW_PARTICLES
        }
        times, pixels = interleaved(calls, seconds, device), evidence.hand.numel()
        yield from (_row("scoring", name, n, pixels, took) for name, took in times.items())


def decode_times(seconds: float, device: torch.device) -> list[Row]:
    """The decoding of latents drawn from the box of each space."""
    calls: dict[str, Callable[[], object]] = {}
    for kind in KINDS:
        space = fit_pose_space(kind, 4).to(device)
        generator = torch.Generator(device).manual_seed(0)
        unit = torch.rand(_LATENTS, space.dims, generator=generator, device=device)
        calls[kind] = partial(space.decode, space.lower + unit * (space.upper - space.lower))
    times = interleaved(calls, seconds, device)
    return [_row("decoding", name, _LATENTS, None, found) for name, found in times.items()]


def frame_times(name: str, overrides: Sequence[str], seconds: float) -> list[Row]:
    """Whole frames of the packaged recording, rectification included, capture and drawing not: as
    they are tracked, with a start in each, and with a search in each."""
    tracker = make_tracker(*overrides)
    with make_device("device=sample") as device:
        camera, frames = device.camera, [(frame.depth, frame.radial) for frame in device]

    def step(index: int, anew: bool = False) -> tuple[float, Mapping[str, float]]:
        if anew:
            tracker.state = replace(tracker.state, tracks=())
        depth, radial = frames[index % len(frames)]
        began = time.perf_counter()
        rectified = camera.rectify(depth, radial)
        rectifying = time.perf_counter() - began
        tracker.step(rectified, camera.K, index, 0.04 * index)
        took = time.perf_counter() - began
        # Where no hand is reported, nothing was done but to look for one.
        spent = tracker.info.seconds if tracker.info else {"detector": took - rectifying}
        return took, {"rectification": rectifying, **spent}

    def row(what: str, found: Sequence[tuple[float, Mapping[str, float]]]) -> Row:
        n, pixels = tracker.model.filter.particles, camera.width * camera.height
        parts = {
            part: 1e3 * statistics.median(spent.get(part, 0.0) for _, spent in found)
            for part in PARTS
        }
        return _row("whole frame", what, n, pixels, [t for t, _ in found]) | {"parts": parts}

    starts = [step(index, anew=True) for index in range(_STARTS)]
    step(_STARTS)
    tracked = []
    began = time.perf_counter()
    for index in cycle(range(_STARTS + 1, len(frames))):
        tracked.append(step(index))
        if len(tracked) >= _FEWEST_FRAMES and time.perf_counter() - began > seconds:
            break
    tracker.restart()
    # The hand and its arm away.
    frames = [
        (np.where(depth > _BODY_M, depth, np.float32(_WALL_M)), radial)
        for depth, radial in frames[:_STARTS]
    ]
    searches = [step(index, anew=True) for index in range(_STARTS)]
    # The first of a kind still waits for what is only done once.
    return [
        row(name, tracked),
        row(f"{name}, start", starts[1:]),
        row(f"{name}, searching", searches[1:]),
    ]


def enlarged(
    camera: Camera, frames: Sequence[tuple[np.ndarray, bool]], size: tuple[int, int]
) -> tuple[Camera, list[tuple[np.ndarray, bool]]]:
    """A camera and its frames (depth, radial) as of one with so many columns and rows: the image is
    in the middle of the larger one, each pixel repeated, with the wall around it."""
    scale = min(size[0] / camera.width, size[1] / camera.height)
    left, top = (
        (of - round(scale * side)) // 2
        for of, side in zip(size, (camera.width, camera.height), strict=True)
    )
    rows, columns = (
        (np.arange(round(scale * side)) / scale).astype(int)
        for side in (camera.height, camera.width)
    )
    images = []
    for depth, radial in frames:
        image = np.full((size[1], size[0]), _WALL_M, np.float32)
        rectified = camera.rectify(depth, radial)
        image[top : top + len(rows), left : left + len(columns)] = rectified[np.ix_(rows, columns)]
        images.append((image, False))
    k = camera.K * np.array([[scale], [scale], [1.0]])
    k[:2, 2] += (scale - 1) / 2 + np.array([left, top])
    return Camera(k, *size), images


def run(
    particles: Sequence[int], compute: str, seconds: float, frames: bool, baselines: bool
) -> dict[str, object]:
    """Measure everything and print each row as it comes; returns what --json writes. Raises
    ToftrackError: no such device."""
    if compute == "cuda" and not torch.cuda.is_available():
        raise ToftrackError("there is no CUDA device here; give --compute cpu")
    device = torch.device(compute)
    machine = {
        "processor": processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "device": torch.cuda.get_device_name() if compute == "cuda" else "cpu",
    }
    print(
        f"{machine['processor']}, {machine['threads']} threads, torch {machine['torch']},"
        f" {machine['device']}\n{'what':<13}{'method':<22}{'N':>7}{'pixels':>9}"
        f"{'min ms':>11}{'median ms':>11}{'repeats':>9}",
        flush=True,
    )
    rows: list[Row] = []
    notes: list[str] = []

    def measured() -> Iterator[Row]:
        yield from score_times(particles, seconds, device, baselines, notes)
        for name, overrides in CONFIGURATIONS.items() if frames else ():
            yield from frame_times(name, [*overrides, f"compute={compute}"], seconds)
        # On the CPU so many as the table's take seconds; there the configuration's say enough.
        for n in particles if frames and compute == "cuda" else ():
            given = (f"filter.particles={n}", f"compute={compute}")
            yield frame_times(f"default, {n}", given, seconds)[0]
        yield from decode_times(seconds, device)

    for row in measured():
        rows.append(row)
        print(_line(row), flush=True)
    return {"machine": machine, "rows": rows, "notes": notes}


def _line(row: Row) -> str:
    """A row as text, and below it the parts of a frame."""
    line = (
        f"{row['table']:<13}{row['method']:<22}{row['count']:>7}{row['pixels'] or '':>9}"
        f"{row['min_ms']:>11.3f}{row['median_ms']:>11.3f}{row['repeats']:>9}"
    )
    parts = (f"    {part:<58}{took:>11.3f}" for part, took in row["parts"].items())
    return "\n".join([line, *parts])
