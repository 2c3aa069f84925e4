"""Time between frames: what settings count in frames is meant at 25 a second."""

from __future__ import annotations

import math

FRAME_S = 1 / 25
"""What "a frame" means in settings."""
_SHORTEST_S, _LONGEST_S = 1 / 120, 0.5
"""The time that is reckoned with: a clock may be coarse, and no prediction reaches farther."""


def elapsed_s(before_s: float | None, now_s: float) -> float:
    """Seconds from one frame to the next, for all that moves and fades in the meantime.

    before_s: None before the first frame. Where the clock went back, as where a recording begins
    anew, or is no number, a frame counts as FRAME_S.
    """
    if before_s is None or not now_s >= before_s:
        return FRAME_S
    passed = now_s - before_s
    return min(max(passed, _SHORTEST_S), _LONGEST_S) if math.isfinite(passed) else FRAME_S
