"""How well a live run kept up with its device: what was dropped, and what was left out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

_MANY = 0.05
"""Share of dropped frames that is worth a word."""
_MOST = 0.5


@dataclass(frozen=True)
class RealTime:
    """Of a run with a live device.

    fps: frames a second that came.  tracked: frames.  reduced: of them, with less than all effort.
    dropped: frames that came too late.
    busy_s: seconds that the tracked ones took together, with all that was done with them.
    longest_gap_s: the longest time from one tracked frame to the next.
    newest_s: time stamp of the newest one; None before the first.
    """

    fps: float
    tracked: int = 0
    reduced: int = 0
    dropped: int = 0
    busy_s: float = 0.0
    longest_gap_s: float = 0.0
    newest_s: float | None = None

    def after(self, timestamp_s: float, took_s: float, reduced: int, dropped: int) -> RealTime:
        """With one more frame.

        reduced, dropped: of all frames until now.
        """
        gap = 0.0 if self.newest_s is None else timestamp_s - self.newest_s
        return replace(
            self,
            tracked=self.tracked + 1,
            reduced=reduced,
            dropped=dropped,
            busy_s=self.busy_s + took_s,
            longest_gap_s=max(self.longest_gap_s, gap),
            newest_s=timestamp_s,
        )

    @property
    def too_slow(self) -> bool:
        """Whether most frames were dropped, so that nothing else can be said of the run."""
        return self.dropped > _MOST * (self.tracked + self.dropped)

    def words(self) -> str:
        """What was dropped and what to do, one or two sentences; empty where it was little."""
        came = self.tracked + self.dropped
        if self.dropped <= _MANY * came:
            return ""
        took_ms = 1e3 * self.busy_s / max(1, self.tracked)
        quality = f", {self.reduced} of them with reduced effort" if self.reduced else ""
        return (
            f"{self.dropped} of {came} frames were dropped: the machine was too slow for "
            f"{self.fps:g} frames/s, a frame took {took_ms:.0f} ms ({self.tracked} were tracked"
            f"{quality}). Let nothing else compute beside it, draw less (view=none), or ask the "
            "camera for fewer frames or smaller images."
        )

    def summary(self) -> dict[str, Any]:
        """What summary.json says of it."""
        said = {
            "fps": round(self.fps, 3),
            "tracked_frames": self.tracked,
            "dropped_frames": self.dropped,
            "reduced_frames": self.reduced,
            "longest_gap_s": self.longest_gap_s,
        }
        return said | ({"note": self.words()} if self.words() else {})
