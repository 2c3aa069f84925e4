"""What every source of frames looks like to the rest of the program."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np

from toftrack.camera import Camera
from toftrack.errors import ToftrackError


@dataclass(frozen=True, eq=False)
class Frame:
    """One image as the device delivered it: neither rectified nor cleaned up."""

    index: int
    """Number of the frame within its recording, or since a live camera was opened."""
    timestamp_s: float
    depth: np.ndarray
    """(H, W) float32 metres; 0, NaN, infinities and negative values are no reading."""
    amplitude: np.ndarray | None
    """(H, W) uint16."""
    radial: bool
    """True: `depth` is the distance along the pixel's ray; False: Z along the optical axis."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of T frames, in the order in which the device yields them."""

    joints_m: np.ndarray
    """(T, 21, 3) metres, camera frame."""
    visible: np.ndarray
    """(T,) bool: the hand is in view."""
    in_space: np.ndarray
    """(T,) bool: the pose lies in the palm-fist-pointing space."""
    visible_fraction: np.ndarray | None = None
    """(T,) share of the hand that is in view and uncovered, 0..1."""
    joint_visible: np.ndarray | None = None
    """(T, 21) bool."""

    def __len__(self) -> int:
        return len(self.joints_m)

    def __getitem__(self, rows: slice) -> Truth:
        """The truth of a range of frames."""

        def cut(values: np.ndarray | None) -> np.ndarray | None:
            return None if values is None else values[rows]

        return Truth(
            joints_m=self.joints_m[rows],
            visible=self.visible[rows],
            in_space=self.in_space[rows],
            visible_fraction=cut(self.visible_fraction),
            joint_visible=cut(self.joint_visible),
        )


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

    def open(self) -> None: ...

    def close(self) -> None: ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *exception: object) -> None: ...

    def __iter__(self) -> Iterator[Frame]: ...


class BaseDevice:
    """A `Device` but for its frames: derive from it, write `__iter__`, and `open` where needed.

    Args:
        camera: of the images.
        fps: frames a second; what the overlay video plays at.
        frames: how many an iteration yields at most; None = nobody knows.
        truth: one row for each of `frames`.
    """

    def __init__(
        self,
        camera: Camera,
        fps: float = 30.0,
        frames: int | None = None,
        truth: Truth | None = None,
    ) -> None:
        self.camera, self.fps, self.frames, self.truth = camera, float(fps), frames, truth
        self.description: dict[str, Any] = {"device": type(self).__name__}
        self.metadata: dict[str, Any] = {}

    def open(self) -> None:
        """Nothing to open."""

    def close(self) -> None:
        """Nothing to close."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Frame]:
        """The frames, in order; raises ToftrackError when the device cannot deliver."""
        raise ToftrackError(f"{type(self).__name__} has no frames; write its method __iter__")
