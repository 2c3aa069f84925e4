"""What an interrupted training goes on from: its own state, written meanwhile.

A checkpoint is a file of `torch.save`, read with `weights_only=True`: tensors and numbers, nothing
that runs. What is read must be of the same training: the batch, the rate, the width, the seed, the
number of hands and the weights that it began from, by their checksum; it continues where it was.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import Tensor, nn

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.safe_files import open_to_read, whole_file

_SUFFIX = ".checkpoint.pt"
_STATES = ("network", "averaged", "optimiser")
_NUMBERS = ("images", "step", "seconds", "course")
_NEWEST = 0.01
"""Weight of a step in the running means."""


@dataclass(eq=False)
class Progress:
    """What changes while a network is trained.

    images: that it is to see in all.  step: batches that it has seen.  seconds: that took.
    course: rows of the errors so far.
    names, recent: means over about the last hundred steps of what they report, kept where that is
        computed.
    """

    network: nn.Module
    averaged: nn.Module
    optimiser: torch.optim.Optimizer
    images: int
    step: int = 0
    seconds: float = 0.0
    course: list[dict[str, Any]] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    recent: Tensor = field(default_factory=lambda: torch.zeros(0))

    def add(self, reported: dict[str, Tensor]) -> None:
        """What a step reports: () tensors. Nobody waits for them."""
        values = torch.stack(list(reported.values())).detach()
        if self.names:
            values = self.recent.to(values.device).lerp(values, _NEWEST)
        self.names, self.recent = list(reported), values

    def means(self) -> dict[str, float]:
        """The running means; waits for the device."""
        return dict(zip(self.names, self.recent.tolist(), strict=True))


@dataclass
class Checkpoints:
    """Where a training's checkpoints are.

    folder: they are written into, one for each network.  minutes: between two.
    resume: folder of an interrupted training to go on with; None = begin.
    """

    folder: Path
    minutes: float
    resume: Path | None = None
    written: float = field(default_factory=time.monotonic)

    def restore(self, name: str, progress: Progress, settings: dict[str, Any]) -> None:
        """Bring a network's training to where it was, if it had begun; settings: what it is by.

        Raises ToftrackError where the folder to resume has no checkpoint, or this one is damaged or
        of another training.
        """
        self.written = time.monotonic()
        if self.resume is None:
            return
        if not any(self.resume.glob(f"*{_SUFFIX}")):
            raise ToftrackError(
                f"there is no checkpoint of a training in {self.resume}; train without resume"
            )
        path = self.resume / f"{name}{_SUFFIX}"
        if not path.exists():
            return
        what = f"{path} is no checkpoint of a training of the detector"
        with reported_errors(what, "train without resume", Exception):  # reading may raise any
            with open_to_read(path) as stream:
                try:
                    content = torch.load(stream, map_location="cpu", weights_only=True)
                except UnpicklingError:  # whose words advise to let the file run what it likes
                    raise ValueError("it is damaged, or holds more than numbers") from None
            before = content["settings"]
            for key, value in settings.items():
                if before[key] != value:
                    raise ToftrackError(
                        f"{path} is a checkpoint of a training with {key}={before[key]}, but now"
                        f" {key}={value}; give the same, or train without resume"
                    )
            for key in _STATES:
                getattr(progress, key).load_state_dict(content[key])
            for key in _NUMBERS:
                setattr(progress, key, content[key])
            recent = content["recent"]
            progress.names, progress.recent = list(recent), torch.tensor(list(recent.values()))

    def write(
        self, name: str, progress: Progress, settings: dict[str, Any], now: bool = False
    ) -> None:
        """Write a checkpoint if it is time for one, or now."""
        if now or time.monotonic() - self.written > 60 * self.minutes:
            save(self.folder / f"{name}{_SUFFIX}", progress, settings)
            self.written = time.monotonic()


def save(path: Path, progress: Progress, settings: dict[str, Any]) -> None:
    """Write a checkpoint; an older one there is replaced only by a whole one."""
    content: dict[str, Any] = {name: getattr(progress, name) for name in _NUMBERS}
    content |= {name: getattr(progress, name).state_dict() for name in _STATES}
    content |= {"settings": settings, "recent": progress.means()}
    with whole_file(path) as stream:
        torch.save(content, stream)
