"""What live cameras behind a vendor's SDK have in common."""

from __future__ import annotations

import logging
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from toftrack.devices.base import KEEP, BaseDevice
from toftrack.devices.seen import cameras_seen
from toftrack.errors import ToftrackError, check_choice, check_number, reported_errors
from toftrack.frames.camera import Camera
from toftrack.frames.frame import Frame

_log = logging.getLogger(__name__)
T = TypeVar("T")
BUSY = (
    "close other programs that use it, plug it in again, into a USB 3 port, and on Linux install "
    "its udev rules"
)
OTHER_FILE = "choose another file (a bag of ROS topics needs no device: toftrack track FILE)"

_LONGEST_GAP_S = 60  # results have a row for each index, so that a wild number must not become one


class FrameNumbers:
    """A camera's frame numbers as indices from 0; what was dropped leaves a gap.

    A camera that counts anew goes on with the next index.  first: number of its first frame; None =
    that of the first one that comes.
    """

    def __init__(self, fps: float, first: int | None = None) -> None:
        self.index, self.dropped = -1, 0
        """Of the latest frame; frames that came between two."""
        self._offset, self._most = first, _LONGEST_GAP_S * fps

    def take(self, number: int) -> int:
        """The index of the next frame, whose number is given."""
        if self._offset is None or not 0 < number - self._offset - self.index <= self._most:
            self._offset = number - self.index - 1
        self.dropped += number - self._offset - self.index - 1
        self.index = number - self._offset
        return self.index


def chosen_serial(
    numbers: Sequence[str], serial: str | int | None, maker: str, otherwise: str = ""
) -> str:
    """The serial number of the camera that is meant, of those plugged in; None: the only one.
    ToftrackError where there is none of it (`otherwise`: what else a user may do), or several and
    none is chosen.
    """
    listed = ", ".join(sorted(numbers))
    if not numbers:
        raise ToftrackError(
            f"no {maker} camera was found ({cameras_seen()}): plug it in, into a USB 3 port; on "
            "Linux its udev rules must be installed; or replay a recording with device.bag=FILE"
            + otherwise
        )
    # A number on the command line loses its zeros.
    meant = {n for n in numbers if serial is None or n.lstrip("0") == str(serial).lstrip("0")}
    if len(meant) == 1:
        return meant.pop()
    those = "" if serial is None else f" with the serial number {serial}"
    raise ToftrackError(
        f"there are {len(meant)} {maker} cameras{those}; set device.serial to one of {listed}"
    )


Size = tuple[int | None, int | None, int | None]
"""Width, height and frames a second; None = whatever the camera proposes."""


def chosen_profile(offered: Sequence[T], size_of: Callable[[T], Size], size: Size, owner: str) -> T:
    """The first profile of that size, of those of depth images that a camera (`owner`) offers.
    ToftrackError where it has no depth images, or none of that size.
    """
    if not offered:
        raise ToftrackError(f"{owner} has no depth images; use a camera with a depth sensor")
    for profile in offered:
        if all(w in (None, s) for w, s in zip(size, size_of(profile), strict=True)):
            return profile
    listed = ", ".join("{}x{} at {}".format(*s) for s in sorted(set(map(size_of, offered))))
    raise ToftrackError(
        f"{owner} has no depth images of device.width={size[0]}, device.height={size[1]}, "
        f"device.fps={size[2]}; set them to one of {listed} (a USB 2 port or cable offers few)"
    )


class SdkCamera(BaseDevice):
    """A camera behind a vendor's SDK, or a recording of that SDK: depth as Z along the optical
    axis, infrared as amplitude, by the camera's own intrinsics.

    The index is the camera's frame number, counted from the first frame; what was dropped leaves a
    gap. Leaving the iteration stops the camera, another iteration starts it again.

    A kind of camera says in `__init__` what it is (after `_begin`, by `_set_up`), and how the SDK
    is asked in the abstract methods. Making one raises ToftrackError: a setting makes no sense, the
    SDK is not installed, there is no camera, the recording cannot be used, or there are no depth
    images of that size.
    """

    kind: str
    """Of the configuration."""
    maker: str
    errors: tuple[type[Exception], ...] = (RuntimeError,)
    """What the SDK raises."""
    first_number: int | None = None
    """Of the first frame; None = whatever comes first."""
    _pipeline: Any
    """Of the SDK; `stop` ends it."""
    _running = False

    def _begin(
        self,
        bag: str | Path | None,
        keep: str,
        queue_frames: int,
        start: int,
        stop: int | None,
        timeout_s: float,
    ) -> None:
        """Check the settings that all such cameras have; raises ToftrackError."""
        check_choice("device.keep", keep, KEEP)
        check_number("device.queue_frames", queue_frames, 2, whole=True)
        check_number("device.timeout_s", timeout_s, 0, above=True)
        check_number("device.start", start, 0, whole=True)
        if stop is not None:
            check_number("device.stop", stop, start + 1, whole=True)
        self._path = None if bag is None else Path(bag).expanduser()
        if self._path is not None and not self._path.is_file():
            raise ToftrackError(f"there is no file '{bag}'; give a recording with device.bag=FILE")
        self._owner = "the camera" if bag is None else f"'{bag}'"
        self._remedy = BUSY if bag is None else OTHER_FILE
        self._capacity = queue_frames if keep == "every" else 1
        self._start, self._stop, self._timeout_s = start, stop, timeout_s
        self._about: dict[str, Any] = {"recording": None if bag is None else str(bag)}
        self._about |= {"keep": keep, "start": start, "stop": stop}

    def _set_up(
        self,
        size: tuple[int, int],
        fps: float,
        live: bool,
        camera_file: str | Path | None,
        own: Callable[[], Camera],
        **about: Any,
    ) -> None:
        """What is known of the images; `own` gives the camera where there is no file of one."""
        camera = own() if camera_file is None else Camera.load_for(camera_file, *size, self._owner)
        super().__init__(camera, fps, live=live)
        if self._path is None and self._stop is not None:
            self.frames = self._stop - self._start
        more = {"fps": self.fps, "camera_file": None if camera_file is None else str(camera_file)}
        self.description = {"device": self.kind, "size": list(size), **self._about, **about, **more}

    def open(self) -> None:
        """Start the camera, or the recording; ToftrackError when it cannot be."""
        if self._running:
            return
        what = f"the {self.maker} camera was found, but cannot be started"
        if self._path is not None:
            what = f"'{self._path}' cannot be replayed"
        with reported_errors(what, self._remedy, *self.errors):
            self._run()
        self._running = True

    def close(self) -> None:
        """Stop the camera; a second call does nothing."""
        if not self._running:
            return
        self._running = False
        try:
            self._pipeline.stop()
        except self.errors as error:  # of a camera that is gone
            _log.warning("%s: %s", self.kind, error)

    @abstractmethod
    def _run(self) -> None:
        """Start the SDK's pipeline."""

    @abstractmethod
    def _take(self) -> Any | None:
        """The next set of frames; None where none has come for a tenth of a second."""

    @abstractmethod
    def _over(self) -> bool:
        """No more frames will come from a recording; asked only when none is there."""

    @abstractmethod
    def _plugged_in(self) -> bool: ...

    @abstractmethod
    def _number(self, depth: Any) -> int:
        """The camera's number of a depth frame."""

    @abstractmethod
    def _frame(self, came: Any, depth: Any, index: int) -> Frame:
        """A set of frames and its depth frame as ours."""

    def __iter__(self) -> Iterator[Frame]:
        self.open()
        self.dropped = 0
        numbers, delivered, begun = FrameNumbers(self.fps, self.first_number), 0, False
        try:
            while self._stop is None or numbers.index + 1 < self._stop:
                came = self._wait(begun)
                if came is None:
                    break
                depth = came.get_depth_frame()
                if not depth:
                    continue
                begun = True
                index = numbers.take(self._number(depth))
                self.dropped = numbers.dropped
                if index < self._start:
                    continue
                if self._stop is not None and index >= self._stop:
                    break
                delivered += 1
                yield self._frame(came, depth, index)
        finally:
            self.close()
            _log.info("%s: frames: %d delivered, %d dropped", self.kind, delivered, self.dropped)
        if not delivered and self._path is not None:
            raise ToftrackError(
                f"'{self._path}' has {numbers.index + 1} frames, none from start={self._start} on; "
                "choose a smaller device.start"
            )

    def _wait(self, begun: bool) -> Any | None:
        """The next set of frames, None at the end; ToftrackError when none comes."""
        deadline, over = time.monotonic() + self._timeout_s, False
        while True:
            came = self._take()
            if came is not None:
                return came
            if over:
                return None
            over = begun and self._over()  # a recording that has not begun is stopped, too
            if self._path is None and not self._plugged_in():
                raise ToftrackError(
                    f"the {self.maker} camera was unplugged; plug it in and start again (what was "
                    "done until then is kept)"
                )
            if time.monotonic() > deadline:
                if self._path is not None and not begun:
                    raise ToftrackError(f"'{self._path}' has no frame with depth; record it again")
                raise ToftrackError(
                    f"no frame has come from the {self.maker} camera for {self._timeout_s:g} s; "
                    "unplug it and plug it in again, into a USB 3 port, or lower device.width, "
                    "device.height and device.fps"
                )
