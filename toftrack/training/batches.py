"""Batches of training images, which other processes make, in order.

Each batch is drawn by a generator of its own, of the seed and the batch's number, so that the
batches are the same however many processes make them.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import resource_tracker
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset

from toftrack.compute.threads import threads
from toftrack.errors import ToftrackError
from toftrack.training.shapes import ShapeBank, shape_bank

_READY = 6
"""Batches of each process that wait to be trained on."""
_MAKERS = 8
"""At most so many processes make images: one that trains on the CPU takes no more."""
_NICE = 19
"""By how much the processes that make images give way to the one that trains."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


def keep_memory() -> None:
    """Ask glibc to reuse what was freed: the batches' large arrays come and go all the time, and
    fresh pages cost more than half of the time on some machines. Elsewhere nothing happens.
    """
    with contextlib.suppress(OSError, AttributeError, TypeError):  # the last is Windows's
        libc = ctypes.CDLL(None)
        for option in (_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD):
            libc.mallopt(option, 1 << 30)


def makers(device: torch.device) -> int:
    """How many processes make images: where a GPU trains, all cores but one."""
    if device.type == "cpu":
        return min(threads(), _MAKERS)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, (cores or 1) - 1)


@dataclass(frozen=True)
class Batches(Dataset[Any]):
    """Batches by their numbers, NamedTuples of arrays, `image` in half precision, which is more
    than a sensor's. make: what makes a NamedTuple of tensors of (batch, bank, generator).

    Arrays travel by themselves: torch would share its tensors' memory through a helper that a busy
    machine may starve.
    """

    make: Callable[[int, ShapeBank, torch.Generator], Any]
    batch: int
    shapes: int
    seed: int

    def __getitem__(self, number: int) -> Any:
        bank, first = _bank(self.shapes, self.seed)
        generator = torch.Generator().manual_seed((first + number) % 2**32)
        made = self.make(self.batch, bank, generator)
        made = made._replace(image=made.image.half())
        return type(made)(*(one.numpy() for one in made))


@functools.cache
def _bank(shapes: int, seed: int) -> tuple[ShapeBank, int]:
    """The hands of a training, and what its batches' seeds begin from."""
    generator = torch.Generator().manual_seed(seed)
    return shape_bank(shapes, generator), int(torch.randint(2**31, (1,), generator=generator))


def made_batches(batches: Batches, numbers: range, makers: int) -> Iterator[Any]:
    """The batches of these numbers as tensors, made by so many other processes."""
    if not numbers:
        return
    loader = DataLoader(
        batches,
        batch_size=None,
        sampler=numbers,
        num_workers=min(makers, len(numbers)),
        collate_fn=_as_it_is,
        worker_init_fn=_begin,
        multiprocessing_context="spawn",
        prefetch_factor=_READY,
        generator=torch.Generator(),
    )
    with _for_this_process_alone():
        made_by_others = iter(loader)
    for made in made_by_others:
        yield type(made)(*map(torch.from_numpy, made))


@contextlib.contextmanager
def _for_this_process_alone() -> Iterator[None]:
    """Processes that are started within do not end when their group is asked to, as by Ctrl-C: this
    one lets them go, and else it would be told that they died.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # which lets signals through when it begins
    asked = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, asked)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def makers_watched() -> Iterator[None]:
    """Within, a ToftrackError where a process that makes batches has ended: torch raises that
    wherever this one is.
    """
    try:
        yield
    except RuntimeError as error:
        if not str(error).startswith("DataLoader worker"):
            raise
        raise ToftrackError(
            "a process that makes training images has ended; is there enough memory?"
        ) from None


def _as_it_is(batch: Any) -> Any:
    return batch


def _begin(_: int) -> None:
    """In a process that makes images; torch lets it have one thread."""
    if hasattr(os, "nice"):
        os.nice(_NICE)
    keep_memory()
