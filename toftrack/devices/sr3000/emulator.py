"""A virtual SR3000 beneath pyusb: the real driver runs against it, without a camera.

It serves the frames of a recording as the camera would, at a chosen rate, and misbehaves as
configured. What it does is what is assumed of the camera, so it proves that the driver is
consistent and robust, not that the assumptions hold.
"""

from __future__ import annotations

import array
import errno
import os
import re
import threading
import time
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import usb.core
from usb.backend import IBackend

from toftrack.devices.sr3000.transport import UsbSettings, parse_id
from toftrack.errors import ToftrackError, check_number
from toftrack.recordings.frame_store import FrameStore
from toftrack.recordings.sr_frame import FRAME_BYTES, REGISTERS, encode_frame

_PACKET_BYTES = 512
"""Of a bulk endpoint at high speed."""
_PACKETS = FRAME_BYTES // _PACKET_BYTES
_TURN_S = 0.01  # how soon a waiting transfer notices that the camera was unplugged

_OPEN_FAULTS = {
    "missing": "no camera is plugged in",
    "permission": "the user may not open it",
    "busy": "another program has claimed it",
}
"""Faults of the attempts to open the camera, numbered from 0."""

_REQUEST_FAULTS = {
    "timeout": "no frame comes",
    "late": "the frame comes when nobody waits for it any more",
    "refuse": "the request itself is stalled",
    "stall": "the endpoint stalls until it is cleared",
    "io_error": "an error of the bus",
    "overflow": "more data in a packet than fit",
    "short": "the frame ends in the middle of a packet",
    "cut": "the frame ends behind a whole packet, without a word",
    "empty": "a transfer of no bytes",
    "long": "bytes behind the frame",
    "split": "the frame comes in two transfers, cut behind a packet, a later one each time",
    "garbage": "random bytes, as many as a frame has",
    "zeros": "all 0",
    "ones": "all 0xFFFF",
    "unplug_before": "unplugged when the frame is asked for",
    "unplug_during": "unplugged within the frame",
    "unplug_after": "unplugged right behind the frame",
}
"""Faults of the requests for a frame, numbered from 0."""

_CYCLE = tuple(kind for kind in _REQUEST_FAULTS if kind != "late")
"""Of `fault_every`."""
_HARMLESS = {"split", "garbage", "zeros", "ones", "unplug_after"}
"""A whole frame comes nevertheless."""


@dataclass(eq=False)
class _Chunk:
    """A piece of what waits at the bulk IN endpoint."""

    ready_s: float
    """On the monotonic clock."""
    data: memoryview = memoryview(b"")
    ends: bool = False
    """The transfer ends behind it."""
    error: int | None = None
    """Instead of data: the errno of a failed transfer."""


def _parse_faults(texts: Iterable[str]) -> list[tuple[str, float, float]]:
    """Faults written as KIND (always), KIND@7 (once), KIND@7x3 (thrice) or KIND@7+ (from then on):
    the kind, and the numbers of the first and the last attempt or request that it hits.
    ToftrackError for an unknown kind or another form.
    """
    faults: list[tuple[str, float, float]] = []
    for text in map(str, texts):
        match = re.fullmatch(r"([a-z_]+)(?:@(\d+)(\+|x(\d+))?)?", text)
        if match is None or match[1] not in _OPEN_FAULTS | _REQUEST_FAULTS:
            raise ToftrackError(
                f"device.emulated.faults: '{text}' is unknown; give KIND, KIND@7, KIND@7x3 or "
                f"KIND@7+, where KIND is one of {', '.join(_OPEN_FAULTS | _REQUEST_FAULTS)}"
            )
        kind, number, rest, count = match.groups()
        first = int(number or 0)
        always = number is None or rest == "+"
        faults.append((kind, first, np.inf if always else first + int(count or 1) - 1))
    return faults


@dataclass(frozen=True)
class EmulatorSettings:
    """What the virtual camera does; see conf/device/sr3000.yaml."""

    source: str
    fps: float | None
    loop: bool
    faults: tuple[str, ...]
    fault_every: int
    replug_s: float
    late_s: float
    serials: tuple[str, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "faults", tuple(self.faults))
        object.__setattr__(self, "serials", tuple(map(str, self.serials)))
        _parse_faults(self.faults)
        check_number("device.emulated.fault_every", self.fault_every, 0, whole=True)
        if self.fps is not None:
            check_number("device.emulated.fps", self.fps, 0, above=True)


@dataclass(frozen=True)
class _Id:
    camera: int
    plugging: int
    """Unplugging and plugging in again makes another device of the camera."""


@dataclass(eq=False)
class _Handle:
    device: _Id
    claimed: bool = False


class _Descriptor:
    """A USB descriptor in the form that pyusb expects; fields that nobody states are 0."""

    extra_descriptors = ()

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)

    def __getattr__(self, name: str) -> int:
        return 0


class EmulatedBackend(IBackend):
    """pyusb's view of a computer with virtual cameras plugged in.

    source: what the cameras see, 176 x 144 pixels.  range_m: their unambiguous range.
    usb: ids, endpoints and the request that they answer.
    """

    def __init__(
        self, source: FrameStore, settings: EmulatorSettings, range_m: float, usb: UsbSettings
    ) -> None:
        self.served = 0
        """Whole frames put at the endpoint, those of harmless faults included."""
        self.requests = 0
        self.misuse: list[str] = []
        """What a driver did that the USB forbids; empty if all is well."""
        self.registers = bytearray(REGISTERS)
        self.open_handles: set[_Handle] = set()
        self._source, self._settings, self._range_m = source, settings, range_m
        self._usb = usb
        self._faults = _parse_faults(settings.faults)
        self._period_s = 1.0 / (settings.fps or source.fps)
        self._lock = threading.RLock()
        self._queue: deque[_Chunk] = deque()
        self._stalled = False
        self._opens = self._position = self._splits = self._cycled = 0
        self._last_due_s = -np.inf
        self._plugging = 0
        self._back_s = 0.0
        self._random = np.random.default_rng(0)

    @property
    def ended(self) -> bool:
        """The recording is over, and nothing waits at the endpoint."""
        with self._lock:
            over = not self._settings.loop and self._position >= len(self._source)
            return over and not self._queue

    def unplug(self, seconds: float) -> None:
        """Pull the cameras out for some time; the scene goes on."""
        with self._lock:
            self._plugging += 1
            self._back_s = time.monotonic() + seconds
            self._queue.clear()
            self._stalled = False

    # What pyusb asks of a backend.

    def enumerate_devices(self) -> Iterator[_Id]:
        with self._lock:
            there = self._plugged() and self._open_fault() != "missing"
            if not there:
                self._opens += 1  # an attempt that ends here
            serials = self._settings.serials if there else ()
            return iter([_Id(number, self._plugging) for number in range(len(serials))])

    def get_device_descriptor(self, dev: _Id) -> _Descriptor:
        ids = self._usb.ids
        vendor, product = parse_id(ids[min(1, len(ids) - 1)])  # by default the usual SR3000
        return _Descriptor(
            idVendor=vendor,
            idProduct=product,
            iSerialNumber=3,
            bNumConfigurations=1,
            bus=1,
            address=4 + dev.camera + 10 * dev.plugging,
            port_numbers=(1 + dev.camera,),
        )

    def get_configuration_descriptor(self, dev: _Id, config: int) -> _Descriptor:
        if config > 0:
            raise IndexError(config)
        return _Descriptor(bNumInterfaces=1, bConfigurationValue=1)

    def get_interface_descriptor(self, dev: _Id, intf: int, alt: int, config: int) -> _Descriptor:
        if intf > 0 or alt > 0:
            raise IndexError((intf, alt))
        return _Descriptor(bInterfaceNumber=self._usb.interface, bNumEndpoints=2)

    def get_endpoint_descriptor(
        self, dev: _Id, ep: int, intf: int, alt: int, config: int
    ) -> _Descriptor:
        address = (self._usb.endpoint_in, self._usb.endpoint_out)[ep]
        return _Descriptor(bEndpointAddress=address, bmAttributes=2, wMaxPacketSize=_PACKET_BYTES)

    def open_device(self, dev: _Id) -> _Handle:
        with self._lock:
            self._check_plugged(dev)
            if self._open_fault() == "permission":
                self._opens += 1
                raise _error(errno.EACCES)
            handle = _Handle(dev)
            self.open_handles.add(handle)
            return handle

    def close_device(self, handle: _Handle) -> None:
        with self._lock:
            if handle not in self.open_handles:
                self.misuse.append("a handle was closed twice")
            if handle.claimed and handle.device.plugging == self._plugging:
                self.misuse.append("a handle was closed with its interface claimed")
            handle.claimed = False
            self.open_handles.discard(handle)

    def get_configuration(self, handle: _Handle) -> int:
        with self._lock:
            self._check(handle, claimed=False)
            return 1

    def set_configuration(self, handle: _Handle, config_value: int) -> None:
        with self._lock:
            self._check(handle, claimed=False)

    def claim_interface(self, handle: _Handle, intf: int) -> None:
        with self._lock:
            self._check(handle, claimed=False)
            fault = self._open_fault()
            self._opens += 1
            if fault == "busy":
                raise _error(errno.EBUSY)
            handle.claimed = True

    def release_interface(self, handle: _Handle, intf: int) -> None:
        with self._lock:
            handle.claimed = False
            self._check(handle, claimed=False)

    def is_kernel_driver_active(self, handle: _Handle, intf: int) -> bool:
        return False

    def clear_halt(self, handle: _Handle, ep: int) -> None:
        with self._lock:
            self._check(handle)
            self._stalled = False

    def ctrl_transfer(
        self, handle: _Handle, kind: int, request: int, value: int, index: int, data: Any, _: int
    ) -> int:
        with self._lock:
            self._check(handle, claimed=False)
            if (kind, request, value >> 8) == (0x80, 6, 3):
                # A string: number 0 is the list of languages, another one the serial number.
                serial = self._settings.serials[handle.device.camera].encode("utf-16-le")
                text = serial if value & 0xFF else (0x0409).to_bytes(2, "little")
                content = (bytes((2 + len(text), 3)) + text)[: len(data)]
                data[: len(content)] = array.array("B", content)
                return len(content)
            known = self._usb
            expected = (known.request_type, known.request, known.request_value, known.request_index)
            if (kind, request, value, index) != expected:
                raise _error(errno.EPIPE)
            self._check(handle)
            if any(chunk.error == errno.ENODEV for chunk in self._queue):
                raise self._unplugged()
            self._request()
            return 0

    def bulk_write(self, handle: _Handle, ep: int, intf: int, data: Any, timeout: int) -> int:
        with self._lock:
            self._check(handle)
            if ep != self._usb.endpoint_out or len(data) != 2 or data[0] >= REGISTERS:
                raise _error(errno.EPIPE)
            self.registers[data[0]] = data[1]
            return 2

    def bulk_read(self, handle: _Handle, ep: int, intf: int, buff: Any, timeout: int) -> int:
        deadline, target, count = time.monotonic() + timeout / 1000, memoryview(buff), 0
        while True:
            with self._lock:
                self._check(handle)
                if self._stalled:
                    raise _error(errno.EPIPE)
                now = time.monotonic()
                chunk = self._queue[0] if self._queue else None
                if chunk is not None and chunk.ready_s <= now:
                    if chunk.error is not None:
                        self._fail(chunk.error)
                    taken = min(len(chunk.data), len(target) - count)
                    target[count : count + taken] = chunk.data[:taken]
                    count += taken
                    chunk.data = chunk.data[taken:]
                    used_up = not chunk.data
                    if used_up:
                        self._queue.popleft()
                    if count == len(target) or (used_up and chunk.ends):
                        return count
                    continue
                ready_s = np.inf if chunk is None else chunk.ready_s
            if now >= deadline:
                if count:
                    return count  # as libusb, which tells of the time-out only if nothing came
                raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
            time.sleep(max(0.0, min(ready_s - now, deadline - now, _TURN_S)))

    # The camera itself.

    def _plugged(self) -> bool:
        return time.monotonic() >= self._back_s

    def _check_plugged(self, device: _Id) -> None:
        if device.plugging != self._plugging or not self._plugged():
            raise _error(errno.ENODEV)

    def _check(self, handle: _Handle, claimed: bool = True) -> None:
        if handle not in self.open_handles:
            self.misuse.append("a closed handle was used")
            raise _error(errno.EINVAL)
        self._check_plugged(handle.device)
        if claimed and not handle.claimed:
            self.misuse.append("an interface was used without being claimed")
            raise _error(errno.EINVAL)

    def _fault(self, kinds: Collection[str], number: int) -> str | None:
        """The first fault of some kinds that hits an attempt or request."""
        faults = self._faults
        hit = (kind for kind, a, b in faults if kind in kinds and a <= number <= b)
        return next(hit, None)

    def _open_fault(self) -> str | None:
        return self._fault(_OPEN_FAULTS, self._opens)

    def _fail(self, number: int) -> None:
        self._queue.popleft()
        if number == errno.ENODEV:
            raise self._unplugged()
        self._stalled = number == errno.EPIPE
        raise _error(number)

    def _unplugged(self) -> usb.core.USBError:
        self.unplug(self._settings.replug_s)
        return _error(errno.ENODEV)

    def _request_fault(self) -> str | None:
        every = self._settings.fault_every
        if every and (self.requests + 1) % every == 0:
            kind = _CYCLE[self._cycled % len(_CYCLE)]
            self._cycled += 1
            return kind
        return self._fault(_REQUEST_FAULTS, self.requests)

    def _request(self) -> None:
        fault = self._request_fault()
        self.requests += 1
        if fault == "refuse":
            raise _error(errno.EPIPE)
        if fault == "timeout":
            return
        if fault == "unplug_before":
            self._position += 1  # the scene goes on
            raise self._unplugged()
        if fault in ("stall", "io_error"):
            number = errno.EPIPE if fault == "stall" else errno.EIO
            self._queue.append(_Chunk(0.0, error=number))
            return
        data = self._next_frame()
        if data is None:
            return
        due = max(time.monotonic(), self._last_due_s + self._period_s)
        self._last_due_s = due
        if fault == "late":
            due += self._settings.late_s
        if fault is None or fault in _HARMLESS:
            self.served += 1
        if fault == "unplug_after":
            self._position += 1  # the scene goes on
        self._queue.extend(self._transfer(fault, data, due))

    def _transfer(self, fault: str | None, data: bytes, ready_s: float) -> list[_Chunk]:
        """What comes over the wire for a frame, where under a fault something comes."""
        whole = memoryview(data)
        if fault == "overflow":
            return [_Chunk(ready_s, error=errno.EOVERFLOW)]
        if fault == "short":
            return [_Chunk(ready_s, whole[:50_001], ends=True)]
        if fault == "cut":
            return [_Chunk(ready_s, whole[: 99 * _PACKET_BYTES])]
        if fault == "empty":
            return [_Chunk(ready_s, ends=True)]
        if fault == "long":
            return [_Chunk(ready_s, memoryview(data + b"\xa5" * 700), ends=True)]
        if fault == "split":
            self._splits = self._splits % (_PACKETS - 1) + 1
            at = self._splits * _PACKET_BYTES
            return [_Chunk(ready_s, whole[:at], ends=True), _Chunk(ready_s, whole[at:])]
        if fault in ("unplug_during", "unplug_after"):
            came = whole[: 50 * _PACKET_BYTES] if fault == "unplug_during" else whole
            return [_Chunk(ready_s, came), _Chunk(ready_s, error=errno.ENODEV)]
        if fault == "garbage":
            whole = memoryview(self._random.bytes(FRAME_BYTES))
        elif fault in ("zeros", "ones"):
            whole = memoryview((b"\0" if fault == "zeros" else b"\xff") * FRAME_BYTES)
        return [_Chunk(ready_s, whole)]

    def _next_frame(self) -> bytes | None:
        source = self._source
        if self._settings.loop:
            self._position %= len(source)
        elif self._position >= len(source):
            return None
        depth, amplitude = source.image(self._position)
        self._position += 1
        radial_m = source.camera.to_radial(depth, source.radial)
        return encode_frame(radial_m, amplitude, self._range_m)


def _error(number: int) -> usb.core.USBError:
    return usb.core.USBError(os.strerror(number), None, number)
