"""The state of a training, written while it goes on, so that it can be gone on with exactly.

Arrays and JSON, as everything here. What is read must be of the same training: the batch,
the rate, the width, the seed, the number of hands and the weights that it began from, by their
checksum; it continues where it was.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from toftrack.archives import read_archive
from toftrack.errors import ToftrackError
from toftrack.json_text import parse_json
from toftrack.safe_files import whole_file

FORMAT = "toftrack-detector-training"
_VERSION = 5
_NEWEST = 0.01
"""Weight of a step in the running means."""


class RunningMeans:
    """Means over about the last hundred steps of what they report, kept where that is computed."""

    def __init__(self) -> None:
        self._names: list[str] = []
        self._values = torch.zeros(0)

    def add(self, reported: dict[str, Tensor]) -> None:
        """What a step reports: () tensors. Nobody waits for them."""
        values = torch.stack(list(reported.values())).detach()
        if not self._names:
            self._names, self._values = list(reported), values
        else:
            self._values = self._values.to(values.device).lerp(values, _NEWEST)

    def numbers(self) -> dict[str, float]:
        """The means; waits for the device."""
        return dict(zip(self._names, self._values.tolist(), strict=True))

    def set(self, numbers: dict[str, float]) -> None:
        """As they were."""
        self._names = list(numbers)
        self._values = torch.tensor(list(numbers.values()), dtype=torch.float32)


@dataclass
class Progress:
    """What changes while a network is trained.

    images: that it is to see in all.  step: batches that it has seen.  seconds: that took.
    recent: running means.
    course: rows of the errors so far.
    """

    network: nn.Module
    averaged: nn.Module
    optimiser: torch.optim.Optimizer
    images: int
    step: int = 0
    seconds: float = 0.0
    recent: RunningMeans = field(default_factory=RunningMeans)
    course: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class Checkpoints:
    """Where a training's checkpoints are.

    folder: they are written into, one for each network.  minutes: between two.
    resume: folder of an interrupted training to go on with; None = begin.
    """

    folder: Path
    minutes: float
    resume: Path | None = None

    def path(self, name: str, folder: Path | None = None) -> Path:
        """The file of a network's checkpoint."""
        return (self.folder if folder is None else folder) / f"{name}.checkpoint.npz"

    def restore(self, name: str, progress: Progress, settings: dict[str, Any]) -> None:
        """Bring a network's training to where it was, if it had begun; settings: what it is by.

        Raises ToftrackError where the folder to resume is none, or the checkpoint is damaged or of
        another training.
        """
        if self.resume is None:
            return
        if not self.resume.is_dir():
            raise ToftrackError(f"there is no folder {self.resume} of a training to resume")
        path = self.path(name, self.resume)
        if path.exists():
            _restore(path, progress, settings)

    @contextmanager
    def writing(self, name: str, progress: Progress, settings: dict[str, Any]) -> Iterator[Any]:
        """Yields what to call after each step: it writes now and then; the end is written too."""
        last = time.monotonic()

        def stepped() -> None:
            nonlocal last
            if time.monotonic() - last > 60 * self.minutes:
                save(self.path(name), progress, settings)
                last = time.monotonic()

        yield stepped
        save(self.path(name), progress, settings)


def save(path: Path, progress: Progress, settings: dict[str, Any]) -> None:
    """Write a checkpoint; an older one there is replaced only by a whole one."""
    arrays: dict[str, np.ndarray] = {}
    for name in ("network", "averaged"):
        for key, tensor in getattr(progress, name).state_dict().items():
            arrays[f"{name}.{key}"] = tensor.detach().cpu().numpy()
    for number, state in progress.optimiser.state_dict()["state"].items():
        for key, tensor in state.items():
            arrays[f"optimiser.{number}.{key}"] = tensor.detach().cpu().numpy()
    metadata = {
        "format": FORMAT,
        "version": _VERSION,
        "settings": settings,
        "images": progress.images,
        "step": progress.step,
        "seconds": progress.seconds,
        "recent": progress.recent.numbers(),
        "course": progress.course,
    }
    content: dict[str, Any] = {"metadata": np.array(json.dumps(metadata)), **arrays}
    with whole_file(path) as stream:
        np.savez(stream, **content)


def _restore(path: Path, progress: Progress, settings: dict[str, Any]) -> None:
    broken = f"{path} is no checkpoint of a training of the detector; train without resume"
    try:
        arrays = read_archive(path)
        metadata = parse_json(str(arrays.pop("metadata")))
        if metadata["format"] != FORMAT or metadata["version"] != _VERSION:
            raise ValueError("another format")
        before = metadata["settings"]
        for name, value in settings.items():
            if before[name] != value:
                raise ToftrackError(
                    f"{path} is a checkpoint of a training with {name}={before[name]}, and now it"
                    f" is {value}; give the same, or train without resume"
                )
        for name in ("network", "averaged"):
            tensors = {key: torch.from_numpy(array) for key, array in _of(arrays, name).items()}
            getattr(progress, name).load_state_dict(tensors)
        optimiser = progress.optimiser.state_dict()
        state: dict[int, dict[str, torch.Tensor]] = {}
        for key, array in _of(arrays, "optimiser").items():
            number, name = key.split(".")
            state.setdefault(int(number), {})[name] = torch.from_numpy(array)
        progress.optimiser.load_state_dict(
            {"state": state, "param_groups": optimiser["param_groups"]}
        )
        progress.images, progress.step = int(metadata["images"]), int(metadata["step"])
        progress.seconds = float(metadata["seconds"])
        progress.recent.set({name: float(mean) for name, mean in metadata["recent"].items()})
        progress.course = list(metadata["course"])
    except (OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ToftrackError(f"{broken} ({error})") from None


def _of(arrays: dict[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    """Arrays of one part, by their names there."""
    return {
        key.removeprefix(name + "."): array
        for key, array in arrays.items()
        if key.startswith(name + ".")
    }
