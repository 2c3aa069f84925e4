"""Who may use how many threads: many small tensor operations are faster on one."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from threading import Lock
from typing import TypeVar

import torch

Result = TypeVar("Result")
_given: ContextVar[int | None] = ContextVar("toftrack_threads", default=None)
_most: ContextVar[int | None] = ContextVar("toftrack_most_threads", default=None)


@dataclass
class _Inside:
    """How many threads are within `small_operations`, and how many torch had outside."""

    count: int = 0
    outside: int = 1


_inside = _Inside()
_lock = Lock()


def threads() -> int:
    """As many as torch may use, but no more than there are cores for this process, or `at_most`."""
    count = min(_given.get() or torch.get_num_threads(), _most.get() or sys.maxsize)
    if hasattr(os, "sched_getaffinity"):
        count = min(count, len(os.sched_getaffinity(0)))
    return max(1, count)


@contextmanager
def at_most(count: int | None) -> Iterator[None]:
    """Within, `threads` says no more than that; None changes nothing."""
    token = _most.set(count or _most.get())
    try:
        yield
    finally:
        _most.reset(token)


@contextmanager
def small_operations() -> Iterator[None]:
    """Within, torch computes on one thread, and `threads` says how many there were before.

    Operations on a few hundred particles gain nothing from a second thread, and wait for
    milliseconds at its barrier when another process, or the scorer, has the other core. And in a
    forked process OpenMP would wait for ever for threads that only the first one has.
    """
    if _given.get() is not None:
        yield
        return
    with _lock:
        # A thread that is new to torch begins with the number that was set last, in any thread:
        # asked while another one is in here, it would say 1, and would say so ever after.
        if _inside.count == 0:
            _inside.outside = torch.get_num_threads()
        _inside.count += 1
        before = _inside.outside
    token = _given.set(before)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        _given.reset(token)
        with _lock:
            torch.set_num_threads(before)
            _inside.count -= 1


def run_shared(task: Callable[[], object], parts: int) -> None:
    """Run a task that shares out its parts itself, in as many threads as may be used.

    Plain threads, not numba's own: these are one choice for a whole process and some of them do not
    allow calls from two threads at once. One part is done without any.
    """
    if parts <= 1:
        task()
        return
    others = [_pool().submit(task) for _ in range(min(threads(), parts) - 1)]
    task()
    for other in others:
        # A helper that has not begun has nothing left to do.
        if not other.cancel():
            other.result()


def beside(task: Callable[[], Result]) -> Callable[[], Result]:
    """Begin a task in another thread, if there may be one; what is returned waits for its result.

    The task must not need the interpreter's lock for long, or the threads wait for each other.
    """
    if threads() == 1:
        return task
    return _pool().submit(task).result


@functools.cache
def _pool() -> ThreadPoolExecutor:
    """Helper threads of this process: one less than cores, for who asks goes on computing."""
    return ThreadPoolExecutor(max((os.cpu_count() or 1) - 1, 1), "toftrack")


def _in_a_forked_process() -> None:
    """It has the thread that forked and no other: neither helpers, nor who held the lock."""
    global _lock
    _lock = Lock()
    _inside.count = 0 if _given.get() is None else 1
    _pool.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_a_forked_process)
