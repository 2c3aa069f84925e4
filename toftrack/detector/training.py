"""Training of the detector: processes make images, one trains; everything from a seed.

The rate stays where it is for two thirds of the images and then falls to nothing along a line
(Hägele et al., "Scaling laws and compute-optimal training beyond fixed training durations",
NeurIPS 2024), so that a training can still be made longer or shorter while the rate has not begun
to fall. Each batch is drawn by a generator of its own, of the seed and the batch's number, so that
an interrupted training goes on with the batches that it would have seen (checkpoints.py).
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import math
import multiprocessing
import os
import queue as queues
import sys
import time
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from toftrack.compute.threads import threads
from toftrack.detector.checkpoints import Checkpoints, Progress
from toftrack.detector.images import Crops, WideImages, crop_images, wide_images
from toftrack.detector.losses import finder_loss, pose_losses
from toftrack.detector.muon import Muon
from toftrack.detector.network import Finder, PoseNet
from toftrack.detector.shapes import shape_bank
from toftrack.detector.weights import go_on_from
from toftrack.errors import ToftrackError

_READY = 6
"""Batches of each process that wait to be trained on."""
_MAKERS = 8
"""At most so many processes make images: one that trains takes no more."""
_NICE = 19
"""By how much the processes that make images give way to the one that trains."""
_WARM = 300
"""Steps in which the rate rises."""
_STEADY = 2 / 3
"""Share of the images after which it falls."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_DECAY = 0.02
"""Of the weights, times the learning rate, in each step."""
Network = TypeVar("Network", PoseNet, Finder)


@dataclass(frozen=True)
class Schedule:
    """How a network is trained; see conf/train_detector.yaml.

    images: in all; 0 leaves the weights of `start` as they are.  batch: images of a step.  rate:
    the highest learning rate, see rate_at.
    width: channels of the network's first layer.
    start: a file of weights to go on from; None begins from nothing.
    start_share: of these weights in the result, which is the mean of both, weight by weight: what
        the start knew of images unlike those it now learns from is kept so (Wortsman et al.,
        "Robust fine-tuning of zero-shot models", CVPR 2022).
    """

    images: int
    batch: int
    rate: float
    width: int
    start: str | None = None
    start_share: float = 0.0

    def __post_init__(self) -> None:
        for name in ("images", "batch", "width"):
            least = 0 if name == "images" and self.start is not None else 1
            if not (isinstance(getattr(self, name), int) and getattr(self, name) >= least):
                more = "" if name != "images" else ", or 0 with weights to start from"
                raise ToftrackError(f"{name} of a network must be a whole number above 0{more}")
        if not 0 < self.rate < 1:
            raise ToftrackError("rate of a network must be between 0 and 1")
        if not 0 <= self.start_share < 1:
            raise ToftrackError("start_share of a network must be at least 0 and less than 1")
        if self.start_share > 0 and self.start is None:
            raise ToftrackError(
                "start_share of a network needs weights to start from: give start, too, or 0"
            )

    @property
    def steps(self) -> int:
        """Batches in all."""
        return math.ceil(self.images / self.batch)

    def rate_at(self, step: int) -> float:
        """The learning rate of a step, 0, 1, ..."""
        left = (self.steps - step) / ((1 - _STEADY) * self.steps)
        return self.rate * min(1.0, (step + 1) / _WARM, left)


Course = list[dict[str, Any]]
"""How training went: a row every few thousand images, with running means of the errors."""


def train_poses(
    schedule: Schedule, shapes: int, seed: int, checkpoints: Checkpoints | None = None
) -> tuple[PoseNet, Course]:
    """Train the pose network; returns the average of its weights, and the course."""
    torch.manual_seed(seed)
    network = PoseNet(schedule.width)
    network.train().to(memory_format=torch.channels_last)

    def step(crops: Crops) -> tuple[Tensor, dict[str, float]]:
        image = crops.image.to(memory_format=torch.channels_last)
        with torch.autocast("cpu", torch.bfloat16):
            outputs = network.features(image)
        losses = pose_losses(network.decode(image, *outputs), crops, network.anchors)
        reported = {
            "joints_mm": losses.hypothesis_mm,
            "keypoints_mm": losses.keypoints_mm,
            "within_20_mm": losses.within_20,
            "side": losses.side,
            "present": losses.present,
        }
        return losses.total, reported

    return _train(network, "poses", crop_images, step, schedule, shapes, seed, checkpoints)


def train_finder(
    schedule: Schedule, shapes: int, seed: int, checkpoints: Checkpoints | None = None
) -> tuple[Finder, Course]:
    """Train the finder; returns the average of its weights, and the course."""
    torch.manual_seed(seed)
    network = Finder(schedule.width)
    network.train().to(memory_format=torch.channels_last)

    def step(images: WideImages) -> tuple[Tensor, dict[str, float]]:
        image = images.image.to(memory_format=torch.channels_last)
        with torch.autocast("cpu", torch.bfloat16):
            found = network(image)
        loss = finder_loss(found, images)
        return loss, {"loss": float(loss.detach())}

    return _train(network, "finder", wide_images, step, schedule, shapes, seed + 1, checkpoints)


def _train(
    network: Network,
    name: str,
    make: Callable[..., Any],
    step: Callable[[Any], tuple[Tensor, dict[str, float]]],
    schedule: Schedule,
    shapes: int,
    seed: int,
    checkpoints: Checkpoints | None,
) -> tuple[Network, Course]:
    _keep_memory()
    steps = schedule.steps
    start = None
    if schedule.start is not None:
        kind = "pose" if isinstance(network, PoseNet) else "finder"
        start = go_on_from(schedule.start, kind, network, schedule.width)
    begun = deepcopy(network) if schedule.start_share > 0 else None
    optimiser = Muon(network, network.ends, schedule.rate, _DECAY)
    averaged = deepcopy(network)
    progress = Progress(network, averaged, optimiser, schedule.images)
    settings: dict[str, Any] = {"batch": schedule.batch, "rate": schedule.rate}
    settings |= {"width": schedule.width, "shapes": shapes, "seed": seed, "start": start}
    writing: Any = contextlib.nullcontext(lambda: None)
    if checkpoints is not None:
        checkpoints.restore(name, progress, settings)
        _check_length(name, progress, schedule)
        writing = checkpoints.writing(name, progress, settings)
    recent, course = progress.recent, progress.course
    before, began = progress.seconds, time.perf_counter()
    done = progress.step * schedule.batch
    bar = tqdm(
        total=steps * schedule.batch, initial=done, unit=" images", desc=name, file=sys.stderr
    )
    with bar, writing as stepped:
        for batch in _batches(make, schedule.batch, range(progress.step, steps), shapes, seed):
            number = progress.step
            for group in optimiser.param_groups:
                group["lr"] = schedule.rate_at(number)
            loss, reported = step(batch)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimiser.step()
            _average(averaged, network, min(0.998, (number + 1) / (number + 10)))
            for key, value in reported.items():
                recent[key] = 0.99 * recent.get(key, value) + 0.01 * value
            bar.update(schedule.batch)
            progress.step = number + 1
            progress.seconds = before + time.perf_counter() - began
            if (number + 1) % 100 == 0 or number + 1 == steps:
                bar.set_postfix({k: f"{v:.3g}" for k, v in recent.items()}, refresh=False)
                images = (number + 1) * schedule.batch
                seconds = round(progress.seconds, 1)
                course.append({"images": images, "seconds": seconds} | recent)
            stepped()
    if begun is not None:
        _average(averaged, begun, 1 - schedule.start_share)
    return averaged, course


def _check_length(name: str, progress: Progress, schedule: Schedule) -> None:
    """A training that goes on may end elsewhere than was meant, if neither would have begun to end.

    Raises ToftrackError.
    """
    meant = replace(schedule, images=progress.images)
    if meant.steps != schedule.steps and progress.step > _STEADY * min(meant.steps, schedule.steps):
        raise ToftrackError(
            f"the training of {name} has seen {progress.step * schedule.batch} images of"
            f" {meant.images}: its rate falls, or would have to already, so that {name}.images"
            f" cannot become {schedule.images} any more; give {meant.images}"
        )
    progress.images = schedule.images


def _keep_memory() -> None:
    """Ask glibc to reuse what was freed: the batches' large arrays come and go all the time, and
    fresh pages cost more than half of the time on some machines. Elsewhere nothing happens.
    """
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        for option in (_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD):
            libc.mallopt(option, 1 << 30)


@torch.no_grad()
def _average(averaged: nn.Module, network: nn.Module, kept: float) -> None:
    """Move all weights and statistics towards another network's, of which `kept` stays."""
    for old, new in zip(averaged.state_dict().values(), network.state_dict().values(), strict=True):
        if old.is_floating_point():
            old.lerp_(new, 1 - kept)
        else:
            old.copy_(new)


def _batches(
    make: Callable[..., Any], batch: int, numbers: range, shapes: int, seed: int
) -> Iterator[Any]:
    """The batches of these numbers, made by other processes, in order."""
    if len(numbers) == 0:
        return
    context = multiprocessing.get_context("spawn")
    makers: list[tuple[Any, Any]] = []
    count = min(threads(), len(numbers), _MAKERS)
    try:
        for first in range(count):
            queue, mine = context.Queue(_READY), numbers[first::count]
            worker = context.Process(
                target=_make_batches, args=(queue, make, batch, mine, shapes, seed), daemon=True
            )
            worker.start()
            makers.append((queue, worker))
        for _, (queue, worker) in zip(numbers, itertools.cycle(makers), strict=False):
            while True:
                try:
                    yield _tensors(*queue.get(timeout=10))
                    break
                except queues.Empty:
                    if not worker.is_alive():
                        raise ToftrackError(
                            "a process that makes training images has ended; is there enough"
                            " memory?"
                        ) from None
    finally:
        for _, worker in makers:
            worker.terminate()
            worker.join()


def _make_batches(
    queue: Any, make: Callable[..., Any], batch: int, numbers: range, shapes: int, seed: int
) -> None:
    if hasattr(os, "nice"):
        os.nice(_NICE)
    torch.set_num_threads(1)
    _keep_memory()
    generator = torch.Generator().manual_seed(seed)
    bank = shape_bank(shapes, generator)
    first = int(torch.randint(2**31, (1,), generator=generator))
    for number in numbers:
        generator.manual_seed((first + number) % 2**32)
        queue.put(_arrays(make(batch, bank, generator)))


def _arrays(batch: Any) -> tuple[type, list[np.ndarray]]:
    """A batch as arrays, which travel by themselves: torch would share memory through a helper that
    a busy machine may starve. Images in half precision, which is more than a sensor's.
    """
    values = [getattr(batch, field.name).numpy() for field in fields(batch)]
    return type(batch), [v.astype(np.float16) if v.ndim == 4 else v for v in values]


def _tensors(kind: type, arrays: list[np.ndarray]) -> Any:
    """The batch again."""
    return kind(*(torch.from_numpy(a.astype(np.float32) if a.ndim == 4 else a) for a in arrays))
