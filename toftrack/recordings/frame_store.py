"""What every recording is when it is open: frames with a camera."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from toftrack.camera import Camera
from toftrack.frames import Truth

DEFAULT_FPS = 25.0


class FrameStore:
    """T frames in an order, each to be had by its number."""

    camera: Camera
    fps: float
    timestamp_s: np.ndarray
    """(T,) float64, not decreasing."""
    metadata: dict[str, Any]
    radial: bool = False
    """True: the depth is the distance along each pixel's ray; False: Z along the axis."""
    truth: Truth | None = None
    unit_m: float | None = None
    """Metres of one step, where the images are whole numbers."""
    damage: str | None = None
    """Why it ends earlier than it should, in words; None when it is whole."""

    def __len__(self) -> int:
        return len(self.timestamp_s)

    @abstractmethod
    def image(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Depth, (H, W) float32 metres, 0 = no reading, a new array, and amplitude, (H, W) uint16
        or None.

        Raises ToftrackError when it cannot be read, is damaged, or of another size.
        """

    def close(self) -> None:
        """Close the file, if one is open; it opens again by itself."""


def rate_of(timestamp_s: np.ndarray, otherwise: float = DEFAULT_FPS) -> float:
    """Frames a second, by the median step of times; otherwise: where they do not tell it."""
    median = float(np.median(np.diff(timestamp_s))) if len(timestamp_s) > 1 else 0.0
    return 1.0 / median if median > 0 else otherwise
