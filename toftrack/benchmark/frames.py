"""How long whole frames take, from a depth image to an estimate, and on what: see scoring.py."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, field, replace
from itertools import cycle

import hydra
import torch
from omegaconf import DictConfig

from toftrack.api import build_tracker
from toftrack.configuration.compose import configuration_folder
from toftrack.errors import ToftrackError

CONFIGURATIONS: dict[str, tuple[str, ...]] = {
    "default": (),
    "paper": ("experiment=paper",),
}
PARTS = ("segmentation and evidence", "filter: scoring", "filter: rest", "refinement", "rest")
_CONF = configuration_folder()
_FEWEST = 12
_STARTS = 6


@dataclass(frozen=True)
class FrameRow:
    """The time of whole frames of one configuration, milliseconds.

    configuration: its name; "start" in it says that the hand was looked for anew in every frame.
    parts: what a frame in the middle spends on each of PARTS; empty for starts.
    """

    configuration: str
    particles: int
    min_ms: float
    median_ms: float
    repeats: int
    parts: dict[str, float] = field(default_factory=dict)


def frame_times(
    seconds: float, device: torch.device, configurations: dict[str, tuple[str, ...]] | None = None
) -> list[FrameRow]:
    """Whole frames of the packaged recording, capture and drawing excluded.

    seconds: how long to time each configuration.
    configurations: overrides by name; None = CONFIGURATIONS.
    Raises ToftrackError where the configuration files are not beside the package.
    """
    rows = []
    for name, overrides in (configurations or CONFIGURATIONS).items():
        config = _config([*overrides, f"compute={device.type}"])
        rows += _times(name, config, seconds)
    return rows


def _config(overrides: list[str]) -> DictConfig:
    if not (_CONF / "config.yaml").is_file():
        raise ToftrackError(
            f"whole frames cannot be timed: there are no configuration files in {_CONF}; run the"
            " benchmark from a checkout of toftrack"
        )
    with hydra.initialize_config_dir(str(_CONF), version_base="1.3"):
        return hydra.compose("config", overrides=["device=sample", *overrides])


def _times(name: str, config: DictConfig, seconds: float) -> list[FrameRow]:
    tracker = build_tracker(config)
    with hydra.utils.instantiate(config.device) as device:
        frames = [
            (device.camera.rectify(frame.depth, frame.radial), device.camera.K) for frame in device
        ]

    def step(index: int) -> float:
        depth, k = frames[index % len(frames)]
        began = time.perf_counter()
        tracker.step(depth, k, index, 0.04 * index)
        return time.perf_counter() - began

    starts = []
    for index in range(_STARTS):
        tracker.state = replace(tracker.state, track=None)
        starts.append(step(index))
    # Young tracks are still compared with a new start in every frame.
    young = range(_STARTS, _STARTS + tracker.model.lost.probation + 1)
    for index in young:
        step(index)
    whole: list[float] = []
    parts: dict[str, list[float]] = {part: [] for part in PARTS}
    began = time.perf_counter()
    for index in cycle(range(young.stop, len(frames))):
        whole.append(step(index))
        assert tracker.info is not None
        for part, found in parts.items():
            found.append(tracker.info.seconds.get(part, 0.0))
        if len(whole) >= _FEWEST and time.perf_counter() - began > seconds:
            break
    shares = {part: 1e3 * statistics.median(found) for part, found in parts.items()}
    n = tracker.model.filter.particles
    # The first start of a process still waits for what is only done once.
    return [_row(name, n, whole, shares), _row(f"{name}, start", n, starts[1:], {})]


def _row(name: str, particles: int, found: list[float], parts: dict[str, float]) -> FrameRow:
    median = 1e3 * statistics.median(found)
    return FrameRow(name, particles, 1e3 * min(found), median, len(found), parts)
