"""The SwissRanger SR3000, live: over USB, through the vendor's library, or emulated.

Nothing here has met a real camera. What is known of the interface and what is assumed stands in
`conf/device/sr3000.yaml`, each setting with its source.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from toftrack.camera import Camera
from toftrack.devices.base import BaseDevice
from toftrack.devices.sr3000.emulator import EmulatedBackend
from toftrack.devices.sr3000.faults import EmulatorSettings
from toftrack.devices.sr3000.libmesasr import MesaTransport
from toftrack.devices.sr3000.reader import Capture, Counts, Reader
from toftrack.devices.sr3000.transport import (
    Exposure,
    MesaSettings,
    Persistence,
    Transport,
    UsbSettings,
)
from toftrack.devices.sr3000.usb import UsbTransport
from toftrack.errors import ToftrackError
from toftrack.frames import Frame
from toftrack.recordings.sr_frame import HEIGHT, WIDTH, decode_frame, nominal_camera
from toftrack.recordings.store import open_source

_log = logging.getLogger(__name__)


class Sr3000(BaseDevice):
    """A live camera: iterate over it for its frames, as radial distances with amplitudes.

    A thread asks for frames from the first iteration on. An unplugged camera is waited for, and
    the iteration goes on with a gap in the frames' indices when it is back.

    The arguments are those of conf/device/sr3000.yaml; `fps` is the rate that is given to those who
    must know one in advance, while the emulated camera has its own.

    Raises ToftrackError: a setting makes no sense, there is no camera (or library), or the emulated
    camera's recording cannot be used.
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
        sensible = queue_frames >= 1 and (stop is None or stop >= 1) and fps > 0
        if keep not in ("newest", "every") or not sensible:
            raise ToftrackError(
                "device=sr3000 needs keep=newest or every, queue_frames and stop of at least 1 and "
                f"fps above 0, but they are {keep}, {queue_frames}, {stop} and {fps}"
            )
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
        if transport == "usb":
            self._transport = UsbTransport(usb, self.exposure, number)
        elif transport == "libmesasr":
            self._transport = MesaTransport(libmesasr, self.exposure, number)
        elif transport == "emulated":
            backend = self._emulate(emulated)
            self._transport = UsbTransport(usb, self.exposure, number, backend)
        else:
            raise ToftrackError(
                f"device.transport={transport} is unknown; give usb, libmesasr or emulated"
            )
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
        """Stop the thread and release the camera; a second call does nothing."""
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
