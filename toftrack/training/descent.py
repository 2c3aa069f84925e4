"""Training of the detector: processes make images, one trains; everything from a seed.

The rate stays where it is for two thirds of the images and then falls to nothing along a line
(Hägele et al., "Scaling laws and compute-optimal training beyond fixed training durations",
NeurIPS 2024), so that a training can still be made longer or shorter while the rate has not begun
to fall. Then, where the schedule says so, the rate rises once more, to less, and falls again, a
warm restart (Loshchilov and Hutter, "SGDR: stochastic gradient descent with warm restarts", ICLR
2017), and the result is the mean of both ends, weight by weight (Izmailov et al., "Averaging
weights leads to wider optima and better generalization", UAI 2018). On a GPU the processes that
make images set the pace, on all cores but one.

An interrupted training goes on with the batches that it would have seen (batches.py,
checkpoints.py).
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from tqdm import tqdm

from toftrack.compute.transfer import on_device
from toftrack.detector.network import Finder, PoseNet
from toftrack.detector.weights import checksum, go_on_from
from toftrack.errors import ToftrackError, check_number
from toftrack.training.batches import Batches, keep_memory, made_batches, makers, makers_watched
from toftrack.training.checkpoints import Checkpoints, Progress
from toftrack.training.images import Crops, WideImages, crop_images, wide_images
from toftrack.training.losses import finder_loss, pose_losses
from toftrack.training.muon import Muon, half_precision

_WARM = 300
"""Steps in which the rate rises."""
_STEADY = 2 / 3
"""Share of the images after which it falls."""
_DECAY = 0.02
"""Of the weights, times the learning rate, in each step."""
_RESTART_SHARE = 0.5
"""Of the weights that a restart begins from, in the result."""
_RESTART_SEED = 100
"""What is added to the seed for a restart, so that its images and hands are others."""
Network = TypeVar("Network", PoseNet, Finder)


@dataclass(frozen=True)
class Schedule:
    """How a network is trained; see conf/train_detector.yaml for what each does."""

    images: int
    batch: int
    rate: float
    width: int
    start: str | None = None
    restart_images: int = 0
    restart_rate: float = 0.0012

    def __post_init__(self) -> None:
        fewest, more = (1, ", or 0 with weights to start from") if self.start is None else (0, "")
        check_number("images", self.images, fewest, whole=True, remedy=more)
        for name, least in (("batch", 1), ("width", 1), ("restart_images", 0)):
            check_number(name, getattr(self, name), least, whole=True)
        for name in ("rate", "restart_rate"):
            if not 0 < getattr(self, name) < 1:
                raise ToftrackError(f"{name} of a network must be between 0 and 1")

    @property
    def steps(self) -> int:
        """Batches in all."""
        return math.ceil(self.images / self.batch)

    def rate_at(self, step: int) -> float:
        """The learning rate of a step, 0, 1, ..."""
        left = (self.steps - step) / ((1 - _STEADY) * self.steps)
        return self.rate * min(1.0, (step + 1) / _WARM, left)


Course = list[dict[str, Any]]
"""How training went: a row every hundred batches, with running means of the errors."""


def train_network(
    kind: type[Network],
    schedule: Schedule,
    shapes: int,
    seed: int,
    checkpoints: Checkpoints,
    device: torch.device,
) -> tuple[Network, Course]:
    """Train a network on a device; returns the average of its weights, on the CPU, and the course.

    On a CUDA device each step of the pose network is a replay of the first one.
    """
    keep_memory()
    torch.manual_seed(seed)
    network = kind(schedule.width)
    task = _task(network, device)
    start = None if schedule.start is None else go_on_from(schedule.start, network)
    seed = seed + 1 if kind is Finder else seed
    where = (shapes, checkpoints, device)
    course = _descend(network, task, schedule, seed, start, *where)
    if schedule.restart_images > 0 and schedule.images > 0:
        before, first = course[-1], deepcopy(network)
        restart = replace(
            schedule, images=schedule.restart_images, rate=schedule.restart_rate, restart_images=0
        )
        task = replace(task, name=f"{task.name}_restart")
        begun = checksum({k: v.cpu().numpy() for k, v in network.state_dict().items()})
        seed += _RESTART_SEED
        for row in _descend(network, task, restart, seed, begun, *where):
            images = before["images"] + row["images"]
            seconds = round(before["seconds"] + row["seconds"], 1)
            course.append(row | {"images": images, "seconds": seconds})
        _average(network, first, torch.tensor(_RESTART_SHARE, device=device))
    return network.cpu(), course


@dataclass(frozen=True)
class Task:
    """What a network is trained on.

    name: of its checkpoint.  make: see Batches.  losses: of a batch, and what is reported; ()
    tensors.  replayed: a step is recorded once and replayed, on a CUDA device, as all its sizes are
    the same each time.
    """

    name: str
    make: Callable[..., Any]
    losses: Callable[[Any], tuple[Tensor, dict[str, Tensor]]]
    replayed: bool = False


def _task(network: PoseNet | Finder, device: torch.device) -> Task:
    # Networks compute in bfloat16 where that is fast.
    half = half_precision(device) is torch.bfloat16

    def shown(image: Tensor) -> Tensor:
        return on_device(image, device).to(torch.float32, memory_format=torch.channels_last)

    if isinstance(network, Finder):

        def of_images(images: WideImages) -> tuple[Tensor, dict[str, Tensor]]:
            image = shown(images.image)
            with torch.autocast(device.type, torch.bfloat16, half):
                found = network(image)
            loss = finder_loss(found, images)
            return loss, {"loss": loss.detach()}

        return Task("finder", wide_images, of_images)

    def of_crops(crops: Crops) -> tuple[Tensor, dict[str, Tensor]]:
        image = shown(crops.image)
        with torch.autocast(device.type, torch.bfloat16, half, cache_enabled=False):
            outputs = network.features(image)
        return pose_losses(network.decode(image, *outputs), crops, network.anchors)

    return Task("poses", crop_images, of_crops, replayed=device.type != "cpu")


class _Step:
    """One step of a training: losses, gradients, new weights and their average."""

    def __init__(self, task: Task, progress: Progress, device: torch.device) -> None:
        self._task, self._progress, self._device = task, progress, device
        self._rate, self._share = torch.zeros((), device=device), torch.ones((), device=device)
        for group in progress.optimiser.param_groups:
            group["lr"] = self._rate
        self._graph: Any = None

    def __call__(self, batch: Any, rate: float, share: float) -> dict[str, Tensor]:
        """share: of the new weights in the average. Returns what is reported."""
        if self._task.replayed:
            batch = type(batch)(*(on_device(one, self._device) for one in batch))
            if self._graph is None:
                self._record(batch)
        self._rate.fill_(rate)
        self._share.fill_(share)
        if self._graph is None:
            return self._eager(batch)
        for kept, new in zip(self._batch, batch, strict=True):
            kept.copy_(new)
        self._graph.replay()
        return self._reported

    def _eager(self, batch: Any) -> dict[str, Tensor]:
        progress = self._progress
        loss, reported = self._task.losses(batch)
        progress.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(progress.network.parameters(), 5.0)
        progress.optimiser.step()
        _average(progress.averaged, progress.network, self._share)
        return reported

    def _record(self, batch: Any) -> None:
        """As torch.cuda.graph wants it: some steps, here at a rate of 0, then the one to replay."""
        self._batch = type(batch)(*(one.clone() for one in batch))
        self._share.fill_(0)
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):
                self._eager(self._batch)
        torch.cuda.current_stream().wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
            self._reported = self._eager(self._batch)


def _descend(
    network: PoseNet | Finder,
    task: Task,
    schedule: Schedule,
    seed: int,
    start: str | None,
    shapes: int,
    checkpoints: Checkpoints,
    device: torch.device,
) -> Course:
    """Train a network until the rate has fallen to nothing; it is left with the average of its
    weights.

    start: the checksum of the weights that it comes with; None = they are random.
    """
    steps = schedule.steps
    network.train().to(device, memory_format=torch.channels_last)
    averaged = deepcopy(network)
    optimiser = Muon(network, network.ends, schedule.rate, _DECAY)
    progress = Progress(network, averaged, optimiser, schedule.images)
    settings: dict[str, Any] = {"batch": schedule.batch, "rate": schedule.rate}
    settings |= {"width": schedule.width, "shapes": shapes, "seed": seed, "start": start}
    checkpoints.restore(task.name, progress, settings)
    _check_length(task.name, progress, schedule)
    course = progress.course
    before, began = progress.seconds, time.perf_counter()
    images = steps * schedule.batch
    done = progress.step * schedule.batch
    bar = tqdm(total=images, initial=done, unit=" images", desc=task.name, file=sys.stderr)
    batches = Batches(task.make, schedule.batch, shapes, seed)
    step = _Step(task, progress, device)
    with bar, makers_watched():
        for batch in made_batches(batches, range(progress.step, steps), makers(device)):
            number = progress.step
            share = 1 - min(0.998, (number + 1) / (number + 10))
            progress.add(step(batch, schedule.rate_at(number), share))
            bar.update(schedule.batch)
            progress.step = number + 1
            progress.seconds = before + time.perf_counter() - began
            if (number + 1) % 100 == 0 or number + 1 == steps:
                recent = progress.means()
                bar.set_postfix({k: f"{v:.3g}" for k, v in recent.items()}, refresh=False)
                seen = {"images": (number + 1) * schedule.batch}
                course.append(seen | {"seconds": round(progress.seconds, 1)} | recent)
            checkpoints.write(task.name, progress, settings)
    checkpoints.write(task.name, progress, settings, now=True)
    network.load_state_dict(averaged.state_dict())
    return course


def _check_length(name: str, progress: Progress, schedule: Schedule) -> None:
    """A training that goes on may end elsewhere than was meant, if neither would have begun to end.

    name: of the task. Raises ToftrackError.
    """
    network, _, restart = name.partition("_")
    counted = f"{network}.{restart and 'restart_'}images"
    meant = replace(schedule, images=progress.images)
    if meant.steps != schedule.steps and progress.step > _STEADY * min(meant.steps, schedule.steps):
        raise ToftrackError(
            f"{counted} can no longer change from {progress.images} to {schedule.images}: after"
            f" {progress.step * schedule.batch} images the rate is falling, or would have to be"
            f" already; give {counted}={progress.images}"
        )
    progress.images = schedule.images


@torch.no_grad()
def _average(averaged: nn.Module, network: nn.Module, share: Tensor) -> None:
    """Move all weights and statistics towards another network's by a () share of the way."""
    pairs = zip(averaged.state_dict().values(), network.state_dict().values(), strict=True)
    for old, new in pairs:
        if old.is_floating_point():
            old.lerp_(new, share)
        else:
            old.copy_(new)
