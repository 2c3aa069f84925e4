"""How long the stages of a step take."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

REST = "rest"
"""The stage that time counts for while no other one runs."""


class Spans:
    """Wall seconds of stages, from the moment it is made; a second's innermost stage has it."""

    def __init__(self) -> None:
        self._began = self._since = time.perf_counter()
        self._seconds: dict[str, float] = {}
        self._running = [REST]

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Within, time counts for a stage."""
        self._book()
        self._running.append(stage)
        try:
            yield
        finally:
            self._book()
            self._running.pop()

    def seconds(self) -> dict[str, float]:
        """Of each stage until now."""
        self._book()
        return dict(self._seconds)

    def total(self) -> float:
        """Seconds since it was made."""
        return time.perf_counter() - self._began

    def _book(self) -> None:
        now, stage = time.perf_counter(), self._running[-1]
        self._seconds[stage] = self._seconds.get(stage, 0.0) + now - self._since
        self._since = now
