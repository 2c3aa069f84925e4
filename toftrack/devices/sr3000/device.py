"""The SwissRanger SR3000, live: over USB, through the vendor's library, or emulated.

Nothing here has met a real camera. What is known of the interface and what is assumed stands in
`conf/device/sr3000.yaml`, each setting with its source.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from toftrack.devices.base import KEEP, BaseDevice
from toftrack.devices.sr3000.emulator import EmulatedBackend, EmulatorSettings
from toftrack.devices.sr3000.libmesasr import MesaTransport
from toftrack.devices.sr3000.transport import (
    CameraError,
    DamagedFrameError,
    EndOfStreamError,
    Exposure,
    MesaSettings,
    Persistence,
    UnpluggedError,
    UsbSettings,
)
from toftrack.devices.sr3000.usb import WHEN_IT_DOES_NOT_ANSWER, UsbTransport
from toftrack.errors import ToftrackError, check_choice, check_number
from toftrack.frames.camera import Camera
from toftrack.frames.frame import Frame
from toftrack.recordings.sr_frame import HEIGHT, WIDTH, decode_frame, nominal_camera
from toftrack.recordings.store import open_source

_log = logging.getLogger(__name__)
Transport = UsbTransport | MesaTransport


class Sr3000(BaseDevice):
    """A live camera: iterate over it for its frames, as radial distances with amplitudes.

    A thread asks for frames from the first iteration on. An unplugged camera is waited for, and the
    iteration goes on with a gap in the frames' indices when it is back.

    The arguments are those of conf/device/sr3000.yaml; `fps` is the rate that is given to those who
    must know one in advance, while the emulated camera has its own.
    """

    def __init__(
        self,
        transport: str,
        serial: str | int | None,
        keep: str,
        queue_frames: int,
        stop: int | None,
        fps: float,
        modulation_mhz: int,
        integration_time: int | None,
        amplitude_threshold: int,
        usb: UsbSettings,
        libmesasr: MesaSettings,
        emulated: EmulatorSettings,
        persistence: Persistence,
        camera_file: str | Path | None,
    ) -> None:
        check_choice("device.keep", keep, KEEP)
        check_choice("device.transport", transport, ("usb", "libmesasr", "emulated"))
        check_number("device.queue_frames", queue_frames, 1, whole=True)
        check_number("device.fps", fps, 0, above=True)
        if stop is not None:
            check_number("device.stop", stop, 1, whole=True)
        self.exposure = Exposure(modulation_mhz, integration_time, amplitude_threshold)
        super().__init__(nominal_camera(), fps, frames=stop, live=keep == "newest")
        self.emulator: EmulatedBackend | None = None
        self.counts = Counts()
        """What became of the frames; those of the latest iteration."""
        self._waiting = queue_frames if keep == "every" else None
        self._stop, self._persistence = stop, persistence
        self._next_index = 0
        self._reader: Reader | None = None
        self._opened = False
        self._usb = usb
        self._transport: Transport
        number = None if serial is None else str(serial)
        if transport == "libmesasr":
            self._transport = MesaTransport(libmesasr, self.exposure, number)
        else:
            backend = self._emulate(emulated) if transport == "emulated" else None
            self._transport = UsbTransport(usb, self.exposure, number, backend)
        self._transport.check()
        if camera_file is not None:
            self.camera = Camera.load_for(camera_file, WIDTH, HEIGHT, "the SR3000")
        self.description: dict[str, Any] = {
            "device": "sr3000",
            "transport": transport,
            "keep": keep,
            "modulation_mhz": modulation_mhz,
            "integration_time": integration_time,
            "amplitude_threshold": amplitude_threshold,
            "camera_file": None if camera_file is None else str(camera_file),
        }
        if transport == "emulated":
            self.description |= {"source": emulated.source, "faults": list(emulated.faults)}

    def register_writes(self) -> list[tuple[int, int]]:
        """Address and value of the registers that are written when the camera is opened."""
        return self._usb.register_writes(self.exposure)

    def open(self) -> None:
        """Find, claim and configure the camera; ToftrackError, with what to try, otherwise."""
        if self._opened:
            return
        self._transport.open()
        self._opened = True
        self._next_index = 0
        self.description |= self._transport.facts()

    def close(self) -> None:
        if not self._opened:
            return
        self._opened = False
        reader, self._reader = self._reader, None
        if reader is not None and not reader.stop():
            # To close the camera beneath a call that uses it would crash the process.
            _log.warning("sr3000: the camera hangs in a call and cannot be released")
            return
        self._transport.close()
        if reader is not None:
            _log.info("sr3000: frames: %s", self.counts)

    def request_stop(self) -> None:
        """End the iteration, after the frames that were received already. Returns at once."""
        if self._reader is not None:
            self._reader.request_stop()

    def __iter__(self) -> Iterator[Frame]:
        self.dropped = 0
        for capture in self.captures():
            self.dropped = self.counts.dropped
            depth, amplitude = decode_frame(
                capture.data, self.exposure.range_m, self.exposure.amplitude_threshold
            )
            yield Frame(capture.index, capture.timestamp_s, depth, amplitude, radial=True)

    def captures(self) -> Iterator[Capture]:
        """The frames as raw bytes, as the iteration; for recording."""
        self.open()
        if self._reader is not None:
            raise ToftrackError("the camera is being read already; iterate over it only once")
        reader = Reader(
            self._transport, self._persistence, self._waiting, self._next_index, self._stop
        )
        self._reader, self.counts = reader, reader.counts
        try:
            yield from reader
        finally:
            # `close` may have come first, and the next iteration may have begun already.
            if self._reader is reader and reader.stop():
                self._next_index, self._reader = reader.next_index, None
                _log.info("sr3000: frames: %s", reader.counts)

    def _emulate(self, settings: EmulatorSettings) -> EmulatedBackend:
        store = open_source(settings.source)
        if (store.camera.width, store.camera.height) != (WIDTH, HEIGHT):
            raise ToftrackError(
                f"'{settings.source}' has {store.camera.width}x{store.camera.height} pixels; the "
                f"emulated SR3000 needs a recording of {WIDTH}x{HEIGHT}"
            )
        self.camera = store.camera
        self.fps = float(settings.fps or store.fps)
        self.metadata = store.metadata
        if not settings.loop:
            count = len(store)
            self.frames = count if self._stop is None else min(count, self._stop)
            self.truth = None if store.truth is None else store.truth[: self.frames]
        self.emulator = EmulatedBackend(store, settings, self.exposure.range_m, self._usb)
        return self.emulator


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
        self._epoch_s = time.time() - time.perf_counter()
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
        while True:
            with self._changed:
                while not self._buffer and not self._finished:
                    # Waiting for ever without a time-out cannot be interrupted everywhere.
                    self._changed.wait(0.5)
                if not self._buffer:
                    break
                self.counts.delivered += 1
                capture = self._buffer.popleft()
                self._changed.notify_all()
            yield capture
        if self._error is not None:
            raise self._error

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
        capture = Capture(self.next_index, self._epoch_s + time.perf_counter(), data)
        self.next_index += 1
        with self._changed:
            self.counts.received += 1
            if self._waiting is None:
                self.counts.dropped += len(self._buffer)
                self._buffer.clear()
            self._buffer.append(capture)
            self._changed.notify_all()
            most = math.inf if self._waiting is None else self._waiting
            while len(self._buffer) >= most and not self._stop.is_set():
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
