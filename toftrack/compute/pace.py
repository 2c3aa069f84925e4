"""Time between frames, of which settings mean 25 a second, and how long the stages of one take."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

FRAME_S = 1 / 25
"""What "a frame" means in settings."""
_SHORTEST_S, _LONGEST_S = 1 / 120, 0.5
"""The time that is reckoned with: a clock may be coarse, and no prediction reaches farther."""


def elapsed_s(before_s: float | None, now_s: float) -> float:
    """Seconds from one frame to the next, for all that moves and fades in the meantime.

    before_s: None before the first frame. Where the clock went back, as where a recording begins
    anew, a frame counts as FRAME_S.
    """
    if before_s is None or now_s < before_s:
        return FRAME_S
    return min(max(now_s - before_s, _SHORTEST_S), _LONGEST_S)


@dataclass(frozen=True)
class Duration:
    """How long something has gone on, in seconds; 0 = it has not begun.

    The frame in which it begins counts as FRAME_S, so that a single frame means the same at any
    rate.
    """

    seconds: float = 0.0

    def extended(self, dt_s: float, most_s: float = math.inf) -> Duration:
        """It goes on in a frame dt_s after the last one, of which at most `most_s` count."""
        return Duration(self.seconds + min(dt_s, most_s) if self.seconds else FRAME_S)

    def reached(self, frames: float) -> bool:
        """Whether it has gone on for so many frames of FRAME_S; half a frame is forgiven."""
        return self.seconds > (frames - 0.5) * FRAME_S

    @property
    def begun(self) -> bool:
        """Whether there was a frame of it."""
        return self.seconds > 0


REST = "rest"
"""The stage that time counts for while no other one runs."""


class Spans:
    """Wall seconds of stages, from the moment it is made; a second's innermost stage has it."""

    def __init__(self) -> None:
        self._since = time.perf_counter()
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

    def _book(self) -> None:
        now, stage = time.perf_counter(), self._running[-1]
        self._seconds[stage] = self._seconds.get(stage, 0.0) + now - self._since
        self._since = now
