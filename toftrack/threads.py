"""Who may use how many threads: many small tensor operations are faster on one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

_given: ContextVar[int | None] = ContextVar("toftrack_threads", default=None)


def threads() -> int:
    """As many as torch may use, but no more than there are cores for this process."""
    count = _given.get() or torch.get_num_threads()
    if hasattr(os, "sched_getaffinity"):
        count = min(count, len(os.sched_getaffinity(0)))
    return max(1, count)


@contextmanager
def small_operations() -> Iterator[None]:
    """Within, torch computes on one thread, and `threads` says how many there were before.

    Operations on a few hundred particles gain nothing from a second thread, and wait for
    milliseconds at its barrier when another process, or the scorer, has the other core.
    """
    before = torch.get_num_threads()
    token = _given.set(before)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _given.reset(token)
