"""What live cameras behind a vendor's SDK have in common."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from toftrack.errors import ToftrackError

_LONGEST_GAP_S = 60  # results have a row for each index, so that a wild number must not become one


class FrameNumbers:
    """A camera's frame numbers as indices from 0; what was dropped leaves a gap.

    A camera that counts anew goes on with the next index.

    Args:
        fps: of the camera.
        first: number of its first frame; None = that of the first one that comes.
    """

    def __init__(self, fps: float, first: int | None = None) -> None:
        self.index = -1
        """Of the latest frame."""
        self.dropped = 0
        """Frames that came between two."""
        self._offset, self._most = first, _LONGEST_GAP_S * fps

    def take(self, number: int) -> int:
        """The index of the next frame, whose number is given."""
        if self._offset is None or not 0 < number - self._offset - self.index <= self._most:
            self._offset = number - self.index - 1
        self.dropped += number - self._offset - self.index - 1
        self.index = number - self._offset
        return self.index


@contextlib.contextmanager
def reported_errors(
    what: str, remedy: str, errors: tuple[type[Exception], ...] = (RuntimeError,)
) -> Iterator[None]:
    """Errors of the SDK become one sentence: what, the SDK's words, and what to do."""
    try:
        yield
    except errors as error:
        reason = " ".join(str(error).split())
        raise ToftrackError(f"{what} ({reason}); {remedy}") from error


def check_live(
    device: str, keep: str, queue_frames: int, start: int, stop: int | None, timeout_s: float
) -> None:
    """Raise ToftrackError where the settings that live cameras share make no sense."""
    numbers = isinstance(queue_frames, int) and isinstance(timeout_s, int | float)
    sensible = numbers and queue_frames >= 2 and timeout_s > 0
    if keep not in ("newest", "every") or not sensible:
        raise ToftrackError(
            f"device={device} needs keep=newest or every, queue_frames of at least 2 and timeout_s "
            f"above 0, but they are {keep}, {queue_frames!r} and {timeout_s!r}"
        )
    whole = all(isinstance(number, int) for number in (start, stop) if number is not None)
    if not whole or start < 0 or (stop is not None and stop <= start):
        raise ToftrackError(
            f"device={device} needs whole numbers 0 <= start < stop, but they are "
            f"{start!r} and {stop!r}"
        )


def recording_index_error(path: object, index: int, start: int) -> ToftrackError:
    """What to say of a recording that delivered nothing, its last frame being that of `index`."""
    if index < 0:
        return ToftrackError(f"'{path}' has no frame with depth; record it again")
    return ToftrackError(
        f"'{path}' has no frame from start={start} on, but {index + 1} before; choose a smaller "
        "device.start"
    )
