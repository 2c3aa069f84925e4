"""How long whole frames take, from a depth image to an estimate, and on what: see scoring.py."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import cycle

import hydra
import numpy as np
import torch
from omegaconf import DictConfig

from toftrack.api import build_tracker
from toftrack.camera import Camera
from toftrack.configuration.compose import configuration_folder
from toftrack.errors import ToftrackError

CONFIGURATIONS: dict[str, tuple[str, ...]] = {
    "default": (),
    "paper": ("experiment=paper",),
}
SIZES = ((640, 480), (1280, 720))
"""Columns and rows of larger images, in which the frames of the first configuration are timed."""
BUDGET_MS = {
    "rectification": 0.1,
    "detector": 1.5,
    "segmentation and evidence": 0.6,
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
        "searching" that moreover there was none, but the person and the room; a size, that the
        images were enlarged to it.
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
    seconds: float,
    device: torch.device,
    configurations: dict[str, tuple[str, ...]] | None = None,
    particles: Sequence[int] = (),
) -> list[FrameRow]:
    """Whole frames of the packaged recording, rectification included, capture and drawing not.

    seconds: how long to time each configuration.
    configurations: overrides by name; None = CONFIGURATIONS.
    particles: numbers of them to time the first one with besides its own.
    Raises ToftrackError where the configuration files are not beside the package.
    """
    rows: list[FrameRow] = []
    configurations = configurations or CONFIGURATIONS
    for name, overrides in configurations.items():
        config = _config([*overrides, f"compute={device.type}"])
        enlarged = () if rows else SIZES
        rows += _times(name, config, seconds)
        for width, height in enlarged:
            rows += _times(f"{name}, {width}x{height}", config, seconds, (width, height))[:1]
    name, overrides = next(iter(configurations.items()))
    for number in particles:
        config = _config([*overrides, f"filter.particles={number}", f"compute={device.type}"])
        rows += _times(f"{name}, {number}", config, seconds)[:1]
    return rows


def _config(overrides: list[str]) -> DictConfig:
    if not (_CONF / "config.yaml").is_file():
        raise ToftrackError(
            f"whole frames cannot be timed: there are no configuration files in {_CONF}; run the"
            " benchmark from a checkout of toftrack"
        )
    with hydra.initialize_config_dir(str(_CONF), version_base="1.3"):
        return hydra.compose("config", overrides=["device=sample", *overrides])


def _times(
    name: str, config: DictConfig, seconds: float, size: tuple[int, int] | None = None
) -> list[FrameRow]:
    tracker = build_tracker(config)
    with hydra.utils.instantiate(config.device) as device:
        camera, frames = device.camera, [(frame.depth, frame.radial) for frame in device]
    if size is not None:
        camera, frames = enlarged(camera, frames, size)

    def step(index: int) -> tuple[float, Mapping[str, float]]:
        depth, radial = frames[index % len(frames)]
        began = time.perf_counter()
        rectified = camera.rectify(depth, radial)
        rectifying = time.perf_counter() - began
        tracker.step(rectified, camera.K, index, 0.04 * index)
        took = time.perf_counter() - began
        assert tracker.info is not None
        return took, {"rectification": rectifying, **tracker.info.seconds}

    def anew(index: int) -> tuple[float, Mapping[str, float]]:
        state = tracker.state
        hands = tuple(replace(hand, track=None) for hand in state.hands)
        tracker.state = replace(state, hands=hands)
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
    step(_STARTS)
    tracked = []
    began = time.perf_counter()
    for index in cycle(range(_STARTS + 1, len(frames))):
        tracked.append(step(index))
        if len(tracked) >= _FEWEST and time.perf_counter() - began > seconds:
            break
    tracker.restart()
    frames = [(_without_hand(depth), radial) for depth, radial in frames[:_STARTS]]
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


def _place(width: int, height: int, size: tuple[int, int]) -> tuple[float, int, int]:
    """How much larger an image fits into another size, and its first column and row there."""
    scale = min(size[0] / width, size[1] / height)
    return scale, (size[0] - round(scale * width)) // 2, (size[1] - round(scale * height)) // 2


def enlarged(
    camera: Camera, frames: Sequence[tuple[np.ndarray, bool]], size: tuple[int, int]
) -> tuple[Camera, list[tuple[np.ndarray, bool]]]:
    """A camera and its frames (depth, radial) as of a camera with so many columns and rows."""
    depths = [camera.rectify(*frame) for frame in frames]
    return _enlarged_camera(camera, size), [(_enlarged(depth, size), False) for depth in depths]


def _enlarged(depth_m: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """An image (H, W) in the middle of a larger one, each pixel repeated, with the wall around."""
    scale, left, top = _place(depth_m.shape[1], depth_m.shape[0], size)
    rows, columns = (np.arange(round(scale * side)) / scale for side in depth_m.shape)
    image = np.full((size[1], size[0]), _WALL_M, np.float32)
    image[top : top + len(rows), left : left + len(columns)] = depth_m[
        np.ix_(rows.astype(int), columns.astype(int))
    ]
    return image


def _enlarged_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """The pinhole camera of `_enlarged` images."""
    scale, left, top = _place(camera.width, camera.height, size)
    k = camera.K * np.array([[scale], [scale], [1.0]])
    k[:2, 2] += (scale - 1) / 2 + np.array([left, top])
    return Camera(k, *size)
