#!/usr/bin/env python3
"""Is the tracker as accurate as it was? What CI asks, in less than 90 s.

    python tests/tools/guards.py                 status 1: something is out of bounds
    python tests/tools/guards.py --seeds 0-19    a row a seed

Tracks the packaged sample, tests/data/guards (the side told) and tests/data/empty (the side found),
and compares their means over seeds with BOUNDS: docs/lab/guards.md says where they come from.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path

# Before torch is loaded: one thread is the fastest for small images, and leaves the other cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from toftrack.api import make_tracker
from toftrack.evaluation.measures import Estimates, measured
from toftrack.evaluation.runs import estimates_of
from toftrack.evaluation.statistics import mean_of
from toftrack.recordings.frame_store import FrameStore
from toftrack.recordings.store import open_recording, open_source
from toftrack.tracking.state import TrackerState
from toftrack.tracking.tracker import Tracker

DATA = Path(__file__).parents[1] / "data"
SEEDS = (0, 1, 2)
SAMPLE_MM = 6.2
"""The mean joint error of the sample over SEEDS is at most this, and nothing is lost."""
BOUNDS = {
    "usable_pct": (66.0, 100.0),
    "silent_pct": (0.0, 4.0),
    "jitter_mm": (0.0, 3.0),
    "coverage_pct": (84.0, 95.0),
    "called_hand_pct": (0.0, 3.0),
}
"""Least and largest value of each figure, means over recordings and SEEDS. No three of 20 seeds
leave them, and there is a margin for the floats of other processors: docs/lab/guards.md."""


def recordings(folder: str) -> dict[str, FrameStore]:
    """Those of tests/data/guards or tests/data/empty, by name."""
    return {path.stem: open_recording(path) for path in sorted((DATA / folder).glob("*.npz"))}


@lru_cache
def _tracker(seed: int, side: str) -> tuple[Tracker, TrackerState]:
    """A tracker, which takes seconds to make, and the state that it begins each recording with."""
    tracker = make_tracker(f"seed={seed}", f"hand.side={side}")
    return tracker, tracker.state


def tracked(recording: FrameStore, seed: int, side: str) -> Estimates:
    """What the tracker says of all frames of a recording."""
    camera, (tracker, first) = recording.camera, _tracker(seed, side)
    tracker.state, found = first, []
    for i, time_s in enumerate(recording.timestamp_s.tolist()):
        depth_m = camera.rectify(recording.image(i)[0], recording.radial)
        found.append([tracker.step(depth_m, camera.K, i, time_s)])
    return estimates_of(found)


def sample_figures(seed: int) -> dict[str, float]:
    """Of the sample: its mean joint error, and the share of frames that are lost."""
    sample = open_source("sample")
    assert sample.truth is not None
    found = tracked(sample, seed, "right")
    figures = measured(found, sample.truth).first.trust
    return {
        "seed": seed,
        "sample_mm": float(figures.mean_all_mm or np.nan),
        "sample_lost_pct": 100.0 * float(found.lost.mean()),
    }


def guard_figures(seed: int) -> dict[str, float]:
    """Of the guards, means over recordings; NaN where nothing could be measured."""
    found = []
    for recording in recordings("guards").values():
        assert recording.truth is not None
        side = str(recording.metadata.get("side", "right"))
        found.append(measured(tracked(recording, seed, side), recording.truth).first)
    values: dict[str, float | None] = {
        "seed": seed,
        "usable_pct": mean_of([one.trust.usable_pct for one in found]),
        "silent_pct": mean_of([one.trust.silent_pct for one in found]),
        "jitter_mm": mean_of([one.figures["jitter_mm"] for one in found]),
        "coverage_pct": mean_of([one.figures["in_region_90_pct"] for one in found]),
        "partly_pct": mean_of([one.trust.partly_pct for one in found]),
        "usable_mm": mean_of([one.figures["usable_mean_mm"] for one in found]),
    }
    return {name: np.nan if value is None else value for name, value in values.items()}


def empty_figures(seed: int) -> dict[str, float]:
    """Of rooms, and persons who raise no hand: frames that are called a hand."""
    found = [tracked(one, seed, "auto") for one in recordings("empty").values()]
    return {"called_hand_pct": 100.0 * float(np.mean([(~one.lost).mean() for one in found]))}


def complaints(
    figures: Sequence[dict[str, float]], sample: Sequence[dict[str, float]]
) -> list[str]:
    """A sentence for each figure whose mean over seeds, a row each, is out of its bounds."""
    said = []
    for name, (low, high) in BOUNDS.items():
        mean = float(np.mean([row[name] for row in figures]))
        if not low <= mean <= high:  # also true of NaN
            said.append(f"{name} is {mean:.2f}, out of {low:g} to {high:g}")
    if sample:
        mean = float(np.mean([row["sample_mm"] for row in sample]))
        lost = max(row["sample_lost_pct"] for row in sample)
        if not mean <= SAMPLE_MM:
            said.append(f"the sample's mean joint error is {mean:.2f} mm, above {SAMPLE_MM:g}")
        if lost > 0:
            said.append(f"{lost:.0f} % of the sample's frames are lost")
    return said


def _seeds(text: str) -> tuple[int, ...]:
    first, _, last = text.partition("-")
    return tuple(range(int(first), int(last or first) + 1))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Is the tracker as accurate as it was?")
    parser.add_argument("--seeds", type=_seeds, default=SEEDS, help="0-19: these (0-2)")
    options = parser.parse_args(arguments)
    seeds, processes = options.seeds, min(os.cpu_count() or 1, 8)
    # Each process tracks with one thread, as one process would: the figures are the same.
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        empty = pool.map(empty_figures, seeds)
        guarded = pool.map(guard_figures, seeds)
        sampled = pool.map(sample_figures, SEEDS)
        figures = [one | other for one, other in zip(guarded, empty, strict=True)]
        sample = list(sampled)
    for row in (*sample, *figures):
        print("  ".join(f"{name} {value:.2f}" for name, value in row.items()))
    said = complaints(figures, sample)
    print("\n".join(said) or "all within their bounds", file=sys.stderr if said else sys.stdout)
    return 1 if said else 0


if __name__ == "__main__":
    sys.exit(main())
