"""How long whole frames take, from a depth image to an estimate, and on what: see scoring.py."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import cycle

import hydra
import numpy as np
import torch
from omegaconf import DictConfig

from toftrack.api import build_tracker
from toftrack.configuration.compose import configuration_folder
from toftrack.errors import ToftrackError

CONFIGURATIONS: dict[str, tuple[str, ...]] = {
    "default": (),
    "paper": ("experiment=paper",),
}
BUDGET_MS = {
    "relocaliser": 1.5,
    "segmentation and evidence": 0.7,
    "filter: scoring": 1.5,
    "filter: rest": 1.0,
    "refinement": 1.5,
    "rest": 0.8,
}
"""What a frame is made of, and what each part may take, milliseconds. Of the networks, which look
beside the filter where there is a second core, only what is waited for counts."""
PARTS = tuple(BUDGET_MS)
_CONF = configuration_folder()
_FEWEST = 12
_STARTS = 6
_BODY_M, _WALL_M = 0.9, 1.5
"""From where on the packaged recording shows the body, and where the wall is."""


@dataclass(frozen=True)
class FrameRow:
    """The time of whole frames of one configuration, milliseconds.

    configuration: its name; "start" in it says that the hand was looked for anew in every frame,
        "searching" that moreover there was none, but the person and the room.
    parts: what a frame in the middle spends on each of PARTS.
    """

    configuration: str
    particles: int
    min_ms: float
    median_ms: float
    repeats: int
    parts: dict[str, float] = field(default_factory=dict)

    @property
    def frames_per_s(self) -> float:
        """How many are done in a second."""
        return 1e3 / self.median_ms


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

    def step(index: int) -> tuple[float, Mapping[str, float]]:
        depth, k = frames[index % len(frames)]
        began = time.perf_counter()
        tracker.step(depth, k, index, 0.04 * index)
        took = time.perf_counter() - began
        assert tracker.info is not None
        return took, tracker.info.seconds

    def anew(index: int) -> tuple[float, Mapping[str, float]]:
        tracker.state = replace(tracker.state, track=None)
        return step(index)

    def row(what: str, found: list[tuple[float, Mapping[str, float]]]) -> FrameRow:
        whole = [took for took, _ in found]
        parts = {
            part: 1e3 * statistics.median(spent.get(part, 0.0) for _, spent in found)
            for part in PARTS
        }
        shortest, median = 1e3 * min(whole), 1e3 * statistics.median(whole)
        return FrameRow(what, tracker.model.filter.particles, shortest, median, len(whole), parts)

    starts = [anew(index) for index in range(_STARTS)]
    # Young tracks are still compared with a new start in every frame.
    young = range(_STARTS, _STARTS + int(tracker.model.lost.probation) + 1)
    for index in young:
        step(index)
    tracked = []
    began = time.perf_counter()
    for index in cycle(range(young.stop, len(frames))):
        tracked.append(step(index))
        if len(tracked) >= _FEWEST and time.perf_counter() - began > seconds:
            break
    tracker.restart()
    frames = [(_without_hand(depth), k) for depth, k in frames[:_STARTS]]
    searches = [anew(index) for index in range(_STARTS)]
    # The first of a kind still waits for what is only done once.
    return [
        row(name, tracked),
        row(f"{name}, start", starts[1:]),
        row(f"{name}, searching", searches[1:]),
    ]


def _without_hand(depth_m: np.ndarray) -> np.ndarray:
    """An image (H, W) of the packaged recording with the wall where the hand and its arm are."""
    return np.where(depth_m > _BODY_M, depth_m, np.float32(_WALL_M))
