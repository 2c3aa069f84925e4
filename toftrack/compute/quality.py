"""How much is spent on a frame: all of it, or less where frames come faster than they are tracked.

Only a live device has a budget. What a frame took is measured, so that under a budget two runs are
not alike; recordings are tracked with all effort, and stay reproducible.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from toftrack.errors import check_number

_USED = 0.9
"""Part of the budget that frames may take on average; the rest is for those that take longer."""
_EASY = 0.65
"""Where they take less than this part, more is tried again."""
_NEW = 0.2
"""Part of the newest frame in the average."""
_FEWEST = 4
"""Frames that a level is judged by at least."""
_MOST = 2.0
"""Times the budget that a single frame counts at most: one may be late for any reason."""
_FAR = 1.6
"""Where they take so many times as much on average, a level is passed over."""
_PATIENCE, _MOST_PATIENT = 30, 960
"""Frames at ease before more is tried; twice as many after each time that it was too much."""


@dataclass(frozen=True)
class Quality:
    """What a step spends on a frame.

    threads: at most. Beside another program that takes a core, helpers are waited for longer than
        they help.
    every: frames from one detection of a believed hand to the next.  search: likewise from one
        search of the whole image to the next, while none is followed or one is doubted.
    places: looked at in it, at most.
    """

    threads: int | None = None
    every: int = 1
    search: int = 1
    places: int | None = None


LEVELS = (
    Quality(),
    Quality(threads=1),
    Quality(1, every=2, search=2),
    Quality(1, every=4, search=4, places=2),
)
"""All effort first; each leaves out more than the one before. Fewer particles or passes save little
and cost much of the accuracy: rather frames are dropped."""
REDUCED = 2
"""The first level that leaves something out of the estimate."""


@dataclass(frozen=True)
class Pace:
    """How long frames take, and what follows for the next one.

    budget_s: seconds that a frame may take; None = as long as it takes.  level: of LEVELS.
    mean_s: of the frames at this level, the newest counting most.  frames: how many those are.
    easy: how many of them in a row were at ease.  patience: how many before more is tried.
    trying: more was tried, and has not proved to be possible yet.
    """

    budget_s: float | None = None
    level: int = 0
    mean_s: float = 0.0
    frames: int = 0
    easy: int = 0
    patience: int = _PATIENCE
    trying: bool = False

    @property
    def reduced(self) -> bool:
        """Whether something is left out of the next frame."""
        return self.level >= REDUCED

    def after(self, took_s: float) -> Pace:
        """The pace after a frame that took so long."""
        if self.budget_s is None:
            return self
        took = min(took_s, _MOST * self.budget_s)
        mean = took if not self.frames else self.mean_s + _NEW * (took - self.mean_s)
        frames = self.frames + 1
        easy = self.easy + 1 if mean < _EASY * self.budget_s else 0
        if mean > _USED * self.budget_s and frames >= _FEWEST:
            level = min(self.level + (2 if mean > _FAR * self.budget_s else 1), len(LEVELS) - 1)
            patience = min(2 * self.patience, _MOST_PATIENT) if self.trying else self.patience
            return Pace(self.budget_s, level, patience=patience)
        if easy > self.patience and self.level > 0:
            return Pace(self.budget_s, self.level - 1, patience=self.patience, trying=True)
        proved = frames > 2 * self.patience
        return replace(
            self,
            mean_s=mean,
            frames=frames,
            easy=easy,
            patience=_PATIENCE if proved else self.patience,
            trying=self.trying and not proved,
        )


def pace_within(budget_ms: float | None) -> Pace:
    """A pace of tracker.budget_ms; ToftrackError where that is no budget."""
    if budget_ms is None:
        return Pace()
    check_number("tracker.budget_ms", budget_ms, 0, above=True)
    return Pace(1e-3 * budget_ms)


class Timekeeper:
    """Measures a tracker's frames, and says what may be spent on the next one.

    pace: as of the last frame.  reduced: frames from which something was left out.
    """

    def __init__(self, pace: Pace) -> None:
        self.pace = pace
        self.reduced = 0
        self._began_s: float | None = None
        self._took_s = 0.0

    def begin(self, began_s: float | None = None) -> Quality:
        """A frame begins, now or when it was there; what may be spent on it."""
        if self._began_s is not None:
            self.pace = self.pace.after(self._took_s)
        self._began_s = time.perf_counter() if began_s is None else began_s
        self.reduced += self.pace.reduced
        return LEVELS[self.pace.level]

    def took_s(self) -> float:
        """Seconds since the frame began. It took as long as was said last before the next one."""
        if self._began_s is not None:
            self._took_s = time.perf_counter() - self._began_s
        return self._took_s
