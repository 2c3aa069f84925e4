"""Batches of training images: other processes make them, and a thread fetches them in order.

Each batch is drawn by a generator of its own, of the seed and the batch's number, so that the
batches are the same however many processes make them.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import multiprocessing
import os
import queue as queues
import threading
from collections.abc import Callable, Generator, Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import Tensor

from toftrack.compute.threads import threads
from toftrack.detector.crops import CROP
from toftrack.errors import ToftrackError
from toftrack.training.shapes import shape_bank

_READY = 6
"""Batches of each process that wait to be trained on."""
_WAITING = 2
"""Batches that are here and wait to be trained on."""
_MAKERS = 8
"""At most so many processes make images: one that trains on the CPU takes no more."""
_NICE = 19
"""By how much the processes that make images give way to the one that trains."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


def keep_memory() -> None:
    """Ask glibc to reuse what was freed: the batches' large arrays come and go all the time, and
    fresh pages cost more than half of the time on some machines. Elsewhere nothing happens.
    """
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        for option in (_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD):
            libc.mallopt(option, 1 << 30)


def makers(device: torch.device) -> int:
    """How many processes make images: where a GPU trains, all cores but one."""
    if device.type == "cpu":
        return min(threads(), _MAKERS)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, (cores or 1) - 1)


@contextlib.contextmanager
def prefetched(
    batches: Generator[Any], taken: Callable[[Any], Any] | None
) -> Iterator[Iterator[Any]]:
    """The same batches, fetched, and `taken`, by a thread beside the training."""
    ready: queues.Queue[Any] = queues.Queue(_WAITING)
    ended = threading.Event()

    def put(one: Any) -> bool:
        while not ended.is_set():
            with contextlib.suppress(queues.Full):
                ready.put(one, timeout=0.2)
                return True
        return False

    def fetch() -> None:
        last: Any = None
        try:
            for batch in batches:
                if not put((batch if taken is None else taken(batch), None)):
                    break
        except BaseException as error:
            last = error
        finally:
            batches.close()
        put((None, last))

    def all_of_them() -> Iterator[Any]:
        while True:
            batch, error = ready.get()
            if error is not None:
                raise error
            if batch is None:
                return
            yield batch

    thread = threading.Thread(target=fetch, name="toftrack-batches", daemon=True)
    thread.start()
    try:
        yield all_of_them()
    finally:
        ended.set()
        thread.join()


def made_batches(
    make: Callable[..., Any], batch: int, numbers: range, shapes: int, seed: int, makers: int
) -> Generator[Any]:
    """The batches of these numbers, made by so many other processes, in order."""
    if len(numbers) == 0:
        return
    context = multiprocessing.get_context("spawn")
    working: list[tuple[Any, Any]] = []
    count = min(makers, len(numbers))
    try:
        for first in range(count):
            queue, mine = context.Queue(_READY), numbers[first::count]
            worker = context.Process(
                target=_make_batches, args=(queue, make, batch, mine, shapes, seed), daemon=True
            )
            worker.start()
            working.append((queue, worker))
        for _, (queue, worker) in zip(numbers, itertools.cycle(working), strict=False):
            while True:
                try:
                    yield tensors(queue.get(timeout=10))
                    break
                except queues.Empty:
                    if not worker.is_alive():
                        raise ToftrackError(
                            "a process that makes training images has ended; is there enough"
                            " memory?"
                        ) from None
    finally:
        for _, worker in working:
            worker.terminate()
            worker.join()


def _make_batches(
    queue: Any, make: Callable[..., Any], batch: int, numbers: range, shapes: int, seed: int
) -> None:
    if hasattr(os, "nice"):
        os.nice(_NICE)
    torch.set_num_threads(1)
    keep_memory()
    generator = torch.Generator().manual_seed(seed)
    bank = shape_bank(shapes, generator)
    first = int(torch.randint(2**31, (1,), generator=generator))
    for number in numbers:
        generator.manual_seed((first + number) % 2**32)
        queue.put(arrays(make(batch, bank, generator)))


def arrays(batch: Any) -> Any:
    """A batch as arrays, which travel by themselves: torch would share memory through a helper that
    a busy machine may starve. Images in half precision, which is more than a sensor's.
    """
    return mapped(batch, lambda one: (one.half() if _is_image(one) else one).numpy())


def tensors(batch: Any) -> Any:
    """The batch again, its images in half precision."""
    return mapped(batch, torch.from_numpy)


def _is_image(one: Tensor) -> bool:
    return one.ndim == 4 and one.shape[-1] >= CROP


def mapped(batch: Any, function: Callable[[Any], Any]) -> Any:
    """The same dataclass with a function's results in place of its tensors."""
    values = {field.name: getattr(batch, field.name) for field in fields(batch)}
    return type(batch)(
        **{
            name: mapped(one, function) if is_dataclass(one) else function(one)
            for name, one in values.items()
        }
    )


def tensors_of(batch: Any) -> list[Tensor]:
    """All of a dataclass."""
    found: list[Tensor] = []
    mapped(batch, found.append)
    return found
