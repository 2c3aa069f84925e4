"""What every recording is when it is open: frames with a camera."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from toftrack.camera import Camera
from toftrack.frames import Truth


class FrameStore(Protocol):
    """T frames in an order, each to be had by its number."""

    @property
    def camera(self) -> Camera: ...

    @property
    def fps(self) -> float: ...

    @property
    def radial(self) -> bool:
        """True: the depth is the distance along each pixel's ray; False: Z along the axis."""
        ...

    @property
    def timestamp_s(self) -> np.ndarray:
        """(T,) float64, not decreasing."""
        ...

    @property
    def truth(self) -> Truth | None: ...

    @property
    def metadata(self) -> dict[str, Any]: ...

    def __len__(self) -> int: ...

    def image(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Depth, (H, W) float32 metres, 0 = no reading, and amplitude, (H, W) uint16 or None."""
        ...

    def close(self) -> None: ...
