"""The SR3000 over plain USB (pyusb).

A frame: a control transfer asks for it, then it is read from the bulk IN endpoint. Known from the
vendor's files are the ids, the endpoints and the frame's layout; the request and how registers are
written are those of the camera's predecessor, and nothing here has met a real camera.
"""

from __future__ import annotations

import array
import contextlib
import errno
import time
from collections.abc import Iterable
from typing import Any

import usb.core
import usb.util
from usb.backend import IBackend

from toftrack.devices.seen import cameras_seen
from toftrack.devices.sr3000.transport import (
    DamagedFrameError,
    EndOfStreamError,
    Exposure,
    NoAnswerError,
    UnpluggedError,
    UsbSettings,
    parse_id,
)
from toftrack.errors import ToftrackError, reported_errors
from toftrack.recordings.sr_frame import FRAME_BYTES

_OTHERWISE = (
    "use the vendor's library with device.transport=libmesasr, or try without a camera with "
    "device.transport=emulated"
)
WHEN_IT_DOES_NOT_ANSWER = (
    "open the camera once with the vendor's viewer (its library loads the camera's firmware), "
    + _OTHERWISE
)
# Of what a camera can leave behind, nothing is longer than a few frames.
_LARGEST_DRAIN = 8 * FRAME_BYTES


class UsbTransport:
    """Finds, claims, configures and reads one camera, which is never reset: whether its firmware
    would survive that is not known.

    exposure: written to the camera where the settings say to which registers.  serial: None = the
    only camera.  backend: of pyusb; None = libusb.
    """

    def __init__(
        self,
        settings: UsbSettings,
        exposure: Exposure,
        serial: str | None = None,
        backend: IBackend | None = None,
    ) -> None:
        self._settings, self._exposure = settings, exposure
        self._serial, self._backend = serial, backend
        self._device: Any = None  # a usb.core.Device while it is open
        self._length = -(-FRAME_BYTES // settings.read_multiple) * settings.read_multiple
        self.patience_s = (3 * settings.timeout_ms + settings.drain_ms) / 1000

    def check(self) -> None:
        _let_go([self._find()])

    def open(self) -> None:
        self.close()
        self._device = self._find()
        try:
            self._claim(self._device)
            for address, value in self._settings.register_writes(self._exposure):
                self._write_register(address, value)
            # A program that was killed in mid-frame leaves the rest of the frame behind.
            self._drain()
        except UnpluggedError as fault:
            self.close()
            raise ToftrackError(f"the SR3000 went away while it was opened ({fault})") from None
        except BaseException:
            self.close()
            raise

    def acquire(self) -> bytes:
        if getattr(self._backend, "ended", False):  # an emulated camera's
            raise EndOfStreamError
        if self._device is None:
            raise UnpluggedError("it is not open")
        settings = self._settings
        try:
            what = settings.request_type, settings.request
            place = settings.request_value, settings.request_index
            self._device.ctrl_transfer(*what, *place, None, settings.timeout_ms)
            data = self._read_frame(self._device)
        except usb.core.USBError as error:
            raise self._recovered(error) from error
        if len(data) != FRAME_BYTES:
            self._drain()
            raise DamagedFrameError(f"{len(data)} bytes instead of {FRAME_BYTES}")
        return data

    def close(self) -> None:
        device, self._device = self._device, None
        if device is None:
            return
        # A camera that was pulled out cannot be released any more; the handle still has to go.
        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            usb.util.release_interface(device, self._settings.interface)
        _let_go([device])

    def facts(self) -> dict[str, Any]:
        device = self._device
        if device is None:
            return {}
        return {
            "usb_id": f"{device.idVendor:04x}:{device.idProduct:04x}",
            "usb_place": f"{device.bus}:{device.address}",
            "serial": _serial_number(device),
        }

    def _find(self) -> usb.core.Device:
        ids = {parse_id(text) for text in self._settings.ids}
        names = ", ".join(self._settings.ids)
        what = f"the USB devices cannot be listed to find an SR3000 ({names})"
        remedy = f"check that this user may use USB, {_OTHERWISE}"
        try:
            with reported_errors(what, remedy, usb.core.USBError):
                found = list(
                    usb.core.find(
                        find_all=True,
                        backend=self._backend,
                        custom_match=lambda device: (device.idVendor, device.idProduct) in ids,
                    )
                )
        except usb.core.NoBackendError:
            raise ToftrackError(
                f"no SR3000 can be looked for on USB (ids {names}), because the library "
                "libusb-1.0 is not installed: install it (Debian, Ubuntu: apt install "
                f"libusb-1.0-0), {_OTHERWISE}"
            ) from None
        wanted = ""
        if self._serial is not None:
            wanted = f" with the serial number {self._serial}"
            chosen = [device for device in found if _serial_number(device) == self._serial]
            _let_go(device for device in found if device not in chosen)
            found = chosen
        if not found:
            raise ToftrackError(
                f"no SR3000{wanted} was found on USB (looked for the ids {names}; "
                f"{cameras_seen(self._backend)}): plug it in and switch it on (lsusb must list "
                f"it), {_OTHERWISE}"
            )
        if len(found) > 1:
            numbers = ", ".join(_serial_number(device) or "unreadable" for device in found)
            _let_go(found)
            raise ToftrackError(
                f"{len(found)} cameras were found (serial numbers {numbers}); choose one with "
                "device.serial=NUMBER, or unplug the others"
            )
        return found[0]

    def _claim(self, device: usb.core.Device) -> None:
        interface = self._settings.interface
        try:
            with contextlib.suppress(NotImplementedError):
                if device.is_kernel_driver_active(interface):
                    device.detach_kernel_driver(interface)
            try:
                device.get_active_configuration()
            except usb.core.USBError as error:
                if error.errno is not None:
                    raise
                device.set_configuration()  # pyusb's word for "not configured yet" has no errno
            usb.util.claim_interface(device, interface)
            self._check_endpoints(device)
        except usb.core.USBError as error:
            raise _unopened(error) from error

    def _check_endpoints(self, device: usb.core.Device) -> None:
        there = {
            endpoint.bEndpointAddress
            for interface in device.get_active_configuration()
            if interface.bInterfaceNumber == self._settings.interface
            for endpoint in interface
        }
        writes = self._settings.register_writes(self._exposure)
        for name in ("endpoint_in", "endpoint_out") if writes else ("endpoint_in",):
            address = getattr(self._settings, name)
            if address not in there:
                listed = ", ".join(f"{address:#04x}" for address in sorted(there)) or "none"
                raise ToftrackError(
                    f"the camera has no endpoint {address:#04x} (it has {listed}); set "
                    f"device.usb.{name} to the right one"
                )

    def _write_register(self, address: int, value: int) -> None:
        endpoint, timeout_ms = self._settings.endpoint_out, self._settings.timeout_ms
        what = f"the camera does not take the value {value} for its register {address}"
        remedy = "check device.usb.registers, or leave them out"
        with reported_errors(what, remedy, usb.core.USBError):
            self._device.write(endpoint, bytes((address, value)), timeout_ms)

    def _read_frame(self, device: usb.core.Device) -> bytes:
        """All of one frame, or as much as came of it; more than a frame when more came."""
        settings, parts, count = self._settings, [], 0
        deadline = time.monotonic() + settings.timeout_ms / 1000
        while count < self._length:
            left_ms = max(1, round((deadline - time.monotonic()) * 1000))
            try:
                part = _read(device, settings.endpoint_in, self._length - count, left_ms)
            except usb.core.USBTimeoutError:
                if not count:
                    raise
                break
            parts.append(part)
            count += len(part)
            # Less than a whole packet ends a transfer: nothing more belongs to this frame.
            if not part or len(part) % settings.read_multiple:
                break
        if count == self._length and settings.tail_check_ms:
            # Without a look behind the frame, what is too long would shift all frames after it.
            # Whatever goes wrong here, the frame itself has come as a whole.
            asked = device, settings.endpoint_in, self._length, settings.tail_check_ms
            with contextlib.suppress(usb.core.USBError):
                parts.append(_read(*asked))
        data = b"".join(parts)
        return data[:FRAME_BYTES] if len(data) == self._length else data

    def _drain(self) -> None:
        """Read and drop what the camera still has to send. Raises UnpluggedError."""
        settings, drained, empty = self._settings, 0, 0
        try:
            # An empty transfer may stand before the rest; an endless row of them may not hold us.
            while drained < _LARGEST_DRAIN and empty < 3:
                part = _read(self._device, settings.endpoint_in, self._length, settings.drain_ms)
                drained += len(part)
                empty += not part
        except usb.core.USBTimeoutError:
            return
        except usb.core.USBError as error:
            if error.errno == errno.EPIPE:
                self._clear_stall()
            elif error.errno != errno.EOVERFLOW:
                raise UnpluggedError(_reason(error)) from error

    def _clear_stall(self) -> None:
        try:
            self._device.clear_halt(self._settings.endpoint_in)
        except usb.core.USBError as error:
            raise UnpluggedError(_reason(error)) from error

    def _recovered(self, error: usb.core.USBError) -> Exception:
        """Bring the endpoint back into order; returns the fault that the error amounts to."""
        if error.errno in (errno.ENODEV, errno.ENOENT, errno.ESHUTDOWN, errno.EACCES):
            return UnpluggedError(_reason(error))
        if error.errno == errno.EPIPE:
            self._clear_stall()
        self._drain()
        if error.errno == errno.EOVERFLOW:
            return DamagedFrameError("more data than fit")
        if isinstance(error, usb.core.USBTimeoutError):
            return NoAnswerError("no answer in time")
        return NoAnswerError(_reason(error))


def _read(device: usb.core.Device, endpoint: int, size: int, timeout_ms: int) -> bytes:
    buffer = array.array("B", bytes(size))
    count = device.read(endpoint, buffer, timeout_ms)
    return buffer[:count].tobytes()


def _serial_number(device: usb.core.Device) -> str | None:
    if not device.iSerialNumber:
        return None
    try:
        return device.serial_number
    except (usb.core.USBError, ValueError, NotImplementedError):
        return None  # not readable without permission


def _let_go(devices: Iterable[usb.core.Device]) -> None:
    """Close the handles that reading a serial number, or `open`, has opened."""
    for device in devices:
        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            usb.util.dispose_resources(device)


def _reason(error: usb.core.USBError) -> str:
    return str(error.strerror or error)


def _unopened(error: usb.core.USBError) -> ToftrackError:
    what = "the SR3000 was found, but"
    if error.errno in (errno.EACCES, errno.EPERM):
        return ToftrackError(
            f"{what} this user may not open it: install the udev rule of docs/cameras.md, then "
            "unplug the camera and plug it in again (or, to try, run as root)"
        )
    if error.errno == errno.EBUSY:
        return ToftrackError(
            f"{what} is in use by another program; close that (the vendor's viewer, another "
            "track.py), then start again"
        )
    return ToftrackError(
        f"{what} cannot be opened ({_reason(error)}): unplug it, wait a moment and plug it in again"
    )
