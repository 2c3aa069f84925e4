"""What a view gets to show, and what it may ask of the tracker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from toftrack.frames.camera import Camera
from toftrack.frames.estimate import Estimate
from toftrack.frames.frame import Frame
from toftrack.hand.shape import HandShape
from toftrack.tracking.state import StepInfo

COMMANDS = ("restart", "auto", "right", "left")
"""What a view may ask: a new start, or another hand, which starts anew: of either side, a right or
a left one."""


@dataclass(frozen=True, eq=False)
class TrackedHand:
    """What one slot of the tracker says of a frame; is_vacant(estimate) where it has no hand."""

    estimate: Estimate
    shape: HandShape
    """The hand of the estimate."""
    insight: StepInfo | None
    """What the tracker saw and believed; None where there was nothing to track."""


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """One tracked frame. Nothing in it changes later, so a view may keep it for its own thread."""

    frame: Frame
    """As the device delivered it."""
    depth_m: np.ndarray
    """(H, W) float32 metres, rectified Z on the camera's undistorted grid, 0 = no reading."""
    camera: Camera
    hands: tuple[TrackedHand, ...]
    """One for each slot."""
    told: str | None = None
    """The first hand's side as it was told; None = it is detected."""
    advice: tuple[str, ...] = ()
    """What to try, where the frames before this one hardly showed a hand, or the other one."""
    dropped: int = 0
    """Frames of a live device that came too late, up to this one."""

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """Of the slots."""
        return tuple(hand.estimate for hand in self.hands)


class View:
    """Where tracked frames are shown or kept; made with folder, fps and frames (None: unknown).
    view=none is this one, which keeps nothing.

    Used with `with`, which closes it. It writes nothing before the first frame. It is left when the
    results are written, so it may stay.
    """

    def __init__(self, folder: Path, fps: float, frames: int | None) -> None: ...

    def show(self, tracked: TrackedFrame) -> None:
        """Take one frame; raises ToftrackError when it cannot be kept."""

    def commands(self) -> Sequence[str]:
        """What was asked since the last call, of COMMANDS, in order."""
        return ()

    def close(self) -> None:
        """Finish what is kept; raises ToftrackError when it cannot be."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: Any) -> None:
        self.close()
