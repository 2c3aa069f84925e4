"""What a training goes on from: its own state, written meanwhile, or the weights of another.

A checkpoint is a file of `torch.save`, read with `weights_only=True`: tensors and numbers, nothing
that runs. What is read must be of the same training: the batch, the rate, the width, the seed, the
number of hands and the weights that it began from, by their checksum; it continues where it was.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from toftrack.detector.weights import (
    network_tensors,
    network_width,
    other_networks_refused,
    read_arrays,
)
from toftrack.errors import ToftrackError
from toftrack.safe_files import open_to_read, whole_file

_SUFFIX = ".checkpoint.pt"
_STATES = ("network", "averaged", "optimiser")
_NUMBERS = ("images", "step", "seconds", "course")
_BROKEN = (
    *(OSError, EOFError, pickle.UnpicklingError, LookupError, AttributeError),
    *(TypeError, ValueError, RuntimeError),
)
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
        return (self.folder if folder is None else folder) / f"{name}{_SUFFIX}"

    def restore(self, name: str, progress: Progress, settings: dict[str, Any]) -> None:
        """Bring a network's training to where it was, if it had begun; settings: what it is by.

        Raises ToftrackError where the folder to resume has no checkpoint, or this one is damaged or
        of another training.
        """
        if self.resume is None:
            return
        if not any(self.resume.glob(f"*{_SUFFIX}")):
            raise ToftrackError(
                f"there is no checkpoint of a training in {self.resume}; train without resume"
            )
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
    content: dict[str, Any] = {name: getattr(progress, name) for name in _NUMBERS}
    content |= {name: getattr(progress, name).state_dict() for name in _STATES}
    content |= {"settings": settings, "recent": progress.recent.numbers()}
    with whole_file(path) as stream:
        torch.save(content, stream)


def _restore(path: Path, progress: Progress, settings: dict[str, Any]) -> None:
    try:
        with open_to_read(path) as stream:
            content = torch.load(stream, map_location="cpu", weights_only=True)
        before = content["settings"]
        for name, value in settings.items():
            if before[name] != value:
                raise ToftrackError(
                    f"{path} is a checkpoint of a training with {name}={before[name]}, and now it"
                    f" is {value}; give the same, or train without resume"
                )
        for name in _STATES:
            getattr(progress, name).load_state_dict(content[name])
        for name in _NUMBERS:
            setattr(progress, name, content[name])
        progress.recent.set(content["recent"])
    except _BROKEN as error:
        why = str(error).partition("\n")[0]
        raise ToftrackError(
            f"{path} is no checkpoint of a training of the detector ({why}); train without resume"
        ) from None


def go_on_from(path: str | Path, name: str, network: nn.Module, width: int) -> str:
    """Give a new network, "pose" or "finder" of a width, the weights of a file to train on from.

    A wider network's further channels begin without effect on what is there (as Chen et al.,
    "Net2Net: accelerating learning via knowledge transfer", ICLR 2016, with new channels instead
    of copies).
    Returns the checksum of the file's arrays. Raises ToftrackError as load_weights does, and for a
    narrower network.
    """
    path = Path(path)
    arrays, metadata = read_arrays(path)
    with other_networks_refused(path):
        before, tensors = network_width(metadata, name), network_tensors(arrays, name)
        if before > width:
            raise ToftrackError(
                f"{path} holds weights for a width of {before}, and the width to train is {width};"
                " give that width or more"
            )
        network.load_state_dict(_widened(tensors, network.state_dict()))
    return str(metadata["sha256"])


def _widened(tensors: dict[str, Tensor], fresh: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights of a network in one that has more channels, whose own are `fresh`.

    The new channels see all others, and none of those that were there sees them, at first.
    """
    widened = {}
    for key, new in fresh.items():
        old, out = tensors[key], new.clone()
        if old.ndim > 1 and old.is_floating_point():
            out[: len(old)] = 0
        out[tuple(slice(size) for size in old.shape)] = old
        widened[key] = out
    return widened
