"""What the tests of the tracker share: the packaged recording, configurations, runs over frames.

The recording is rendered from a mesh, by a renderer that is not ours, and carries the truth.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from toftrack.api import build_tracker
from toftrack.configuration.compose import modest_files
from toftrack.devices.base import BaseDevice, Device
from toftrack.devices.replay import Sample
from toftrack.frames.estimate import Estimate
from toftrack.frames.frame import Frame
from toftrack.programs.track import track
from toftrack.tracking.tracker import Tracker

ROOT = Path(__file__).parents[2]
CONF = ROOT / "conf"


def code_of(page: str, name: str) -> str:
    """The block of code that follows the marker of that name in a page of docs/."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    (block,) = re.findall(rf"<!-- test: {name} -->\n```\w+\n(.*?)```", text, re.DOTALL)
    return block


@dataclass(frozen=True, eq=False)
class Scene:
    """Frames with their truth.

    depth_m: (T, H, W) rectified Z, 0 = no reading.  k: (3, 3).  joints_m: (T, 21, 3).
    """

    depth_m: np.ndarray
    k: np.ndarray
    joints_m: np.ndarray

    def __len__(self) -> int:
        return len(self.depth_m)

    def cut(self, *rows: int) -> Scene:
        """The given frames only."""
        return Scene(self.depth_m[list(rows)], self.k, self.joints_m[list(rows)])

    def scaled(self, factor: float) -> Scene:
        """Everything larger and farther away: the image of each hand stays the same."""
        return Scene(self.depth_m * np.float32(factor), self.k, self.joints_m * factor)

    def mirrored(self) -> Scene:
        """Right becomes left."""
        k = self.k.copy()
        k[0, 2] = self.depth_m.shape[2] - 1 - k[0, 2]
        depth = np.ascontiguousarray(self.depth_m[:, :, ::-1])
        return Scene(depth, k, self.joints_m * [-1, 1, 1])


@cache
def sample() -> Scene:
    """All of the packaged recording."""
    device = Sample()
    camera = device.camera
    depth = np.stack([camera.rectify(frame.depth, frame.radial) for frame in device])
    return Scene(depth, np.array(camera.K), device.truth.joints_m.astype(np.float64))


def first(count: int) -> Scene:
    """The first frames of it."""
    return sample().cut(*range(count))


class Camera(BaseDevice):
    """One that gives so many frames of the sample, of every so many one, and fails thereafter."""

    def __init__(
        self,
        count: int,
        every: int = 1,
        live: bool = True,
        fails: type[BaseException] | None = None,
    ) -> None:
        self._sample, self._every, self._fails = Sample(stop=count * every), every, fails
        super().__init__(self._sample.camera, 25.0, live=live)

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._sample:
            if frame.index % self._every == 0:
                self.dropped = frame.index // self._every * (self._every - 1)
                yield frame
        if self._fails is not None:
            raise self._fails("the camera was unplugged")


def configuration(*overrides: str, name: str = "config") -> DictConfig:
    """The configuration of `python track.py` with overrides."""
    return deepcopy(_composed(name, *overrides))


@cache
def _composed(name: str, *overrides: str) -> DictConfig:
    """Composing takes half a second, and most tests ask for the same as others."""
    with modest_files(), initialize_config_dir(str(CONF), version_base="1.3"):
        return compose(name, overrides=list(overrides))


def run(folder: Path, device: Device, *overrides: str) -> None:
    """What `python track.py` does with overrides and an opened device, in this process."""
    hydra = (f"hydra.runtime.output_dir='{folder}'", "hydra.job.num=0", "hydra.job.id=0")
    with modest_files(), initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=[*overrides, *hydra], return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    try:
        track(config, device)
    finally:
        HydraConfig.instance().cfg = None


def make_tracker(*overrides: str) -> Tracker:
    """The tracker of `python track.py` with overrides."""
    return build_tracker(configuration(*overrides))


def follow(scene: Scene, *overrides: str) -> list[Estimate]:
    """Track a scene from its first frame with a new tracker."""
    tracker = make_tracker(*overrides)
    return [tracker.step(depth, scene.k, i, i / 25) for i, depth in enumerate(scene.depth_m)]


def errors_mm(estimates: list[Estimate], scene: Scene) -> np.ndarray:
    """(T,) mean joint error of each frame."""
    found = np.stack([estimate.joints_m for estimate in estimates])
    return 1e3 * np.linalg.norm(found - scene.joints_m[: len(found)], axis=-1).mean(1)
