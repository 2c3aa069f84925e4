"""What every source of frames looks like to the rest of the program."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol, Self, runtime_checkable

from toftrack.camera import Camera
from toftrack.errors import ToftrackError
from toftrack.frames import Frame, Truth


@runtime_checkable
class Device(Protocol):
    """A source of frames: open it (or use `with`), iterate over it, close it.

    `open` and the iteration raise ToftrackError when the device cannot deliver.
    """

    camera: Camera
    fps: float
    frames: int | None
    """How many frames an iteration yields at most; None for a live camera."""
    truth: Truth | None
    """One row for each of `frames`."""
    description: dict[str, Any]
    """Facts for the result's metadata, JSON-able."""
    metadata: dict[str, Any]
    """What the recording says about itself."""
    live: bool
    """Frames do not wait: the newest is delivered, and what comes too late is dropped."""
    dropped: int
    """Frames of the latest iteration that nobody was there to take; 0 unless `live`."""

    def open(self) -> None: ...

    def close(self) -> None: ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *exception: object) -> None: ...

    def __iter__(self) -> Iterator[Frame]: ...


class BaseDevice:
    """A `Device` but for its frames: derive from it, write `__iter__`, and `open` where needed.

    fps: what the overlay video plays at.  The other arguments are fields of `Device`.
    """

    def __init__(
        self,
        camera: Camera,
        fps: float = 30.0,
        frames: int | None = None,
        truth: Truth | None = None,
        live: bool = False,
    ) -> None:
        self.camera, self.fps, self.frames, self.truth = camera, float(fps), frames, truth
        self.live, self.dropped = live, 0
        self.description: dict[str, Any] = {"device": type(self).__name__}
        self.metadata: dict[str, Any] = {}

    def open(self) -> None:
        """Nothing by default."""

    def close(self) -> None:
        """Nothing by default."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Frame]:
        """The frames, in order; raises ToftrackError when the device cannot deliver."""
        raise ToftrackError(f"{type(self).__name__} has no frames; write its method __iter__")
