"""What every source of frames looks like to the rest of the program."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Self, cast

from toftrack.errors import ToftrackError, check_number
from toftrack.frames.camera import Camera
from toftrack.frames.frame import Frame, Truth


class BaseDevice:
    """A source of frames: open it (or use `with`), iterate over it, close it.

    Derive from it, write `__iter__`, and `open` and `close` where needed; `open` and the iteration
    raise ToftrackError when the device cannot deliver.

    camera: of the images; None: `open` sets it.
    fps: frames a second, above 0: what it delivers, or what is expected of it.
    """

    def __init__(
        self,
        camera: Camera | None,
        fps: float = 30.0,
        frames: int | None = None,
        truth: Truth | None = None,
        live: bool = False,
    ) -> None:
        check_number("fps", fps, 0, above=True)
        if not isinstance(camera, Camera | None):
            kind = type(camera).__name__
            raise ToftrackError(f"a device needs Camera(K, width, height), but was given {kind}")
        self.camera = cast(Camera, camera)
        """Of the images."""
        self.fps = float(fps)
        """Frames a second, at which the overlay video plays."""
        self.frames = frames
        """How many an iteration yields at most; None: unknown."""
        self.truth = truth
        """With a row for each of them; None where there is none."""
        self.live = live
        """Frames do not wait: the newest is delivered, and what comes too late is dropped."""
        self.dropped = 0
        """Frames of the latest iteration that nobody was there to take; 0 unless `live`."""
        self.description: dict[str, Any] = {"device": type(self).__name__}
        """Facts for the result's metadata, JSON-able."""
        self.metadata: dict[str, Any] = {}
        """What the recording says about itself."""

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


def frames_of(device: BaseDevice) -> Iterator[Frame]:
    """Its frames; ToftrackError for anything else, which one of somebody's own may yield."""
    for frame in device:
        wrong = "" if isinstance(frame, Frame) else type(frame).__name__
        if not wrong and not hasattr(frame.depth, "shape"):  # a tensor is as good as an array
            wrong = f"one with a depth of {type(frame.depth).__name__}"
        if wrong:
            code: Any = getattr(type(device).__iter__, "__code__", None)
            place = code and f"{code.co_qualname} ({code.co_filename}, line {code.co_firstlineno})"
            raise ToftrackError(
                "a device must yield Frame(index, timestamp_s, depth, amplitude, radial), and "
                "nothing when there is no image, but "
                f"it yielded {wrong}, in {place or type(device).__name__}"
            )
        yield frame


Device = BaseDevice
"""What whoever takes one calls it."""
KEEP = ("newest", "every")
"""What a live camera can do with the frames that wait."""
