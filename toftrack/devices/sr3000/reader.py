"""A thread that keeps asking a camera for frames, through every fault that may pass."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, dataclass

from toftrack.devices.sr3000.transport import (
    CameraError,
    DamagedFrameError,
    EndOfStreamError,
    Persistence,
    Transport,
    UnpluggedError,
)
from toftrack.devices.sr3000.usb import WHEN_IT_DOES_NOT_ANSWER
from toftrack.errors import ToftrackError

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Capture:
    """One whole frame as it came."""

    index: int
    """Counts what the camera sent since it was opened; damaged frames and breaks leave a gap."""
    timestamp_s: float
    """When its last byte came: seconds since 1970, on a clock that never goes back."""
    data: bytes
    """FRAME_BYTES bytes."""


@dataclass
class Counts:
    """What became of the frames that were asked for."""

    received: int = 0
    """Whole frames; each is delivered, dropped, or still waiting."""
    delivered: int = 0
    dropped: int = 0
    """Whole frames that nobody took: a newer one replaced them, or the iteration was left."""
    damaged: int = 0
    """Too short, too long or empty."""
    unanswered: int = 0
    """Time-outs, stalls and errors of the bus."""
    unplugged: int = 0
    """Times that the camera was gone."""

    def __str__(self) -> str:
        return ", ".join(f"{count} {name}" for name, count in asdict(self).items())


class Reader:
    """Reads frames in a thread of its own until it is stopped; iterate over it for the frames.

    The iteration waits for frames. It ends after `stop` or at the end of the stream, when all that
    was received is delivered, and raises ToftrackError when the camera is given up.

    transport: an opened camera; used by the thread alone until `stop` returns.  waiting: None keeps
    only the newest frame and drops older ones; a number keeps every frame, and asks the camera for
    no more while so many are waiting.  end_index: the stream ends before it; None = it goes on.
    """

    def __init__(
        self,
        transport: Transport,
        persistence: Persistence,
        waiting: int | None,
        first_index: int,
        end_index: int | None,
    ) -> None:
        self.counts = Counts()
        self.next_index, self._end_index = first_index, end_index
        self._transport, self._persistence, self._waiting = transport, persistence, waiting
        self._buffer: deque[Capture] = deque()
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._finished = False
        self._error: Exception | None = None
        self._epoch_s = time.time() - time.monotonic()
        self._thread = threading.Thread(target=self._run, name="sr3000-reader", daemon=True)
        self._thread.start()

    def request_stop(self) -> None:
        """Ask for no more frames; what was received is still delivered. Returns at once."""
        self._stop.set()

    def stop(self) -> bool:
        """`request_stop`, drop the frames that still wait, and wait for the thread to end.

        Returns False if it hangs in a call to the camera.
        """
        self._stop.set()
        with self._changed:
            self._changed.notify_all()
        self._thread.join(self._transport.patience_s + 2.0)
        with self._changed:
            self.counts.dropped += len(self._buffer)
            self._buffer.clear()
        return not self._thread.is_alive()

    def __iter__(self) -> Iterator[Capture]:
        while (capture := self._take()) is not None:
            yield capture

    def _take(self) -> Capture | None:
        with self._changed:
            while not self._buffer and not self._finished:
                # Waiting for ever without a time-out cannot be interrupted everywhere.
                self._changed.wait(0.5)
            if self._buffer:
                self.counts.delivered += 1
                capture = self._buffer.popleft()
                self._changed.notify_all()
                return capture
        if self._error is not None:
            raise self._error
        return None

    def _run(self) -> None:
        try:
            self._read_on()
        except EndOfStreamError:
            pass
        except Exception as error:  # told by the thread that iterates
            self._error = error
        finally:
            with self._changed:
                self._finished = True
                self._changed.notify_all()

    def _read_on(self) -> None:
        since, in_a_row, settings = time.monotonic(), 0, self._persistence
        while not self._stop.is_set() and self.next_index != self._end_index:
            try:
                data = self._transport.acquire()
            except CameraError as fault:
                in_a_row += 1
                self._count(fault)
                gone = isinstance(fault, UnpluggedError)
                if gone or in_a_row % settings.reopen_after == 0:
                    self._reopen(since, fault)
                    # A camera that came back gets the time to answer that it got at first.
                    since = time.monotonic() if gone else since
                self._give_up_if_late(since, fault)
            else:
                since, in_a_row = time.monotonic(), 0
                self._put(data)

    def _count(self, fault: CameraError) -> None:
        if isinstance(fault, UnpluggedError):
            self.counts.unplugged += 1
            self.next_index += 1
            _log.warning("sr3000: the camera is gone (%s); waiting for it to come back", fault)
        elif isinstance(fault, DamagedFrameError):
            self.counts.damaged += 1
            self.next_index += 1
        else:
            if self.counts.unanswered == 0:
                _log.warning("sr3000: %s; asking again", fault)
            self.counts.unanswered += 1

    def _put(self, data: bytes) -> None:
        capture = Capture(self.next_index, self._epoch_s + time.monotonic(), data)
        self.next_index += 1
        with self._changed:
            self.counts.received += 1
            if self._waiting is None:
                self.counts.dropped += len(self._buffer)
                self._buffer.clear()
            self._buffer.append(capture)
            self._changed.notify_all()
            while (
                self._waiting is not None
                and len(self._buffer) >= self._waiting
                and not self._stop.is_set()
            ):
                self._changed.wait(0.2)

    def _reopen(self, since: float, fault: CameraError) -> None:
        """Open the camera again, with growing pauses; returns when stopped, too."""
        settings, pause = self._persistence, self._persistence.backoff_s
        self._transport.close()
        while not self._stop.wait(pause):
            try:
                self._transport.open()
                return
            except ToftrackError as error:
                self._give_up_if_late(since, fault, error)
            pause = min(2 * pause, settings.longest_backoff_s)

    def _give_up_if_late(
        self, since: float, fault: CameraError, error: ToftrackError | None = None
    ) -> None:
        settings, waited = self._persistence, time.monotonic() - since
        if self._stop.is_set():
            return
        if self.counts.received == 0 and error is None and waited > settings.first_frame_s:
            raise ToftrackError(
                f"the SR3000 was opened, but has sent no frame for {waited:.0f} s ({fault}): "
                + WHEN_IT_DOES_NOT_ANSWER
            )
        if settings.give_up_s is None or waited <= settings.give_up_s:
            return
        if error is not None:
            raise ToftrackError(
                f"the SR3000 was gone ({fault}) and could not be opened again within {waited:.0f} "
                f"s; the last attempt said: {error}"
            )
        raise ToftrackError(
            f"the SR3000 has sent no whole frame for {waited:.0f} s ({fault}); unplug it, wait a "
            "moment, plug it in again, and check its cable and power"
        )
