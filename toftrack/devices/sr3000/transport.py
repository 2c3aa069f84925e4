"""What the ways to an SR3000 have in common: their face, their faults and their settings.

Every number below is a setting, because some of them were never tried against a camera: see
`conf/device/sr3000.yaml` for each one's unit and source.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from toftrack.checks import check_number
from toftrack.errors import ToftrackError
from toftrack.recordings.sr_frame import MODULATION_CODES, REGISTERS, unambiguous_range_m


class CameraError(Exception):
    """Something went wrong that may pass; the reader tries again and never shows this to a user."""


class NoAnswerError(CameraError):
    """The camera did not send the frame that was asked for."""


class DamagedFrameError(CameraError):
    """A frame came, but not as many bytes as it has."""


class UnpluggedError(CameraError):
    """The camera is gone; it has to be opened anew."""


class EndOfStreamError(Exception):
    """There are no more frames (only an emulated camera's recording ends)."""


class Transport(Protocol):
    """A way to the camera. Only one thread uses it at a time."""

    patience_s: float
    """How long a call of `acquire` may take."""

    def check(self) -> None:
        """Raises ToftrackError when it is plain, without opening it, that there is no camera."""
        ...

    def open(self) -> None:
        """Find, claim and configure the camera. Raises ToftrackError when that cannot be done."""
        ...

    def acquire(self) -> bytes:
        """Ask for one frame and wait for its FRAME_BYTES bytes.

        Raises NoAnswerError, DamagedFrameError or UnpluggedError for what may pass, and
        EndOfStreamError at the end.
        """
        ...

    def close(self) -> None:
        """Let go of the camera; never raises, and a second call does nothing."""
        ...

    def facts(self) -> dict[str, Any]:
        """What is known of the opened camera, JSON-able."""
        ...


@dataclass(frozen=True)
class Exposure:
    """How the camera is to take its images."""

    modulation_mhz: int
    """40, 30, 21, 20 or 19; gives the unambiguous range."""
    integration_time: int | None
    """0..255, (n + 1) x 0.2 ms; None leaves the camera's own."""
    amplitude_threshold: int
    """Pixels of a smaller amplitude have no distance; 0 keeps all."""

    def __post_init__(self) -> None:
        unambiguous_range_m(self.modulation_mhz)
        if self.integration_time is not None:
            check_number("device.integration_time", self.integration_time, 0, 255, whole=True)
        check_number("device.amplitude_threshold", self.amplitude_threshold, 0, 0xFFFF, whole=True)

    @property
    def range_m(self) -> float:
        """The unambiguous range, metres."""
        return unambiguous_range_m(self.modulation_mhz)

    @property
    def modulation_code(self) -> int:
        """The vendor's code of the modulation frequency."""
        return MODULATION_CODES[self.modulation_mhz]


@dataclass(frozen=True)
class UsbSettings:
    """The USB interface as far as it is known; see conf/device/sr3000.yaml."""

    ids: tuple[str, ...]
    interface: int
    endpoint_in: int
    endpoint_out: int
    request_type: int
    request: int
    request_value: int
    request_index: int
    read_multiple: int
    timeout_ms: int
    drain_ms: int
    tail_check_ms: int
    registers: Mapping[int, int]
    """Raw writes when the camera is opened: address to value."""
    integration_time_register: int | None
    modulation_register: int | None

    def __post_init__(self) -> None:
        object.__setattr__(self, "ids", tuple(map(str, self.ids)))
        for text in self.ids:
            parse_id(text)
        if not self.ids:
            raise ToftrackError("device.usb.ids is empty; give at least one VENDOR:PRODUCT")
        for names, least, most in (
            (("timeout_ms", "drain_ms", "read_multiple"), 1, 600_000),
            (("tail_check_ms",), 0, 1000),
            (("interface", "endpoint_in", "endpoint_out", "request_type", "request"), 0, 255),
            (("request_value", "request_index"), 0, 0xFFFF),
        ):
            for name in names:
                check_number(f"device.usb.{name}", getattr(self, name), least, most, whole=True)
        registers = {}
        for address, value in dict(self.registers).items():
            address = int(address) if str(address).isdecimal() else address
            check_number("device.usb.registers: an address", address, 0, REGISTERS - 1, whole=True)
            check_number(f"device.usb.registers: the value of {address}", value, 0, 255, whole=True)
            registers[address] = value
        object.__setattr__(self, "registers", registers)
        for name in ("integration_time_register", "modulation_register"):
            if (value := getattr(self, name)) is not None:
                check_number(f"device.usb.{name}", value, 0, REGISTERS - 1, whole=True)

    def register_writes(self, exposure: Exposure) -> list[tuple[int, int]]:
        """Address and value of what is written when the camera is opened, in this order."""
        writes = list(self.registers.items())
        if self.integration_time_register is not None and exposure.integration_time is not None:
            writes.append((self.integration_time_register, exposure.integration_time))
        if self.modulation_register is not None:
            writes.append((self.modulation_register, exposure.modulation_code))
        return writes


@dataclass(frozen=True)
class MesaSettings:
    """The vendor's library."""

    library: str
    mode: int
    """0x01 fixed-pattern correction + 0x04 median of 3x3, as the vendor proposes."""
    timeout_ms: int

    def __post_init__(self) -> None:
        check_number("device.libmesasr.mode", self.mode, 0, 0x7FFFFFFF, whole=True)
        check_number("device.libmesasr.timeout_ms", self.timeout_ms, 1, 600_000, whole=True)


@dataclass(frozen=True)
class Persistence:
    """How long to go on trying."""

    first_frame_s: float
    """A camera that was opened but has sent nothing for so long does not answer."""
    give_up_s: float | None
    """The same later on, and for an unplugged camera to come back; None = for ever."""
    backoff_s: float
    """Before the first attempt to open an unplugged camera again; doubles from one to the next."""
    longest_backoff_s: float
    reopen_after: int
    """So many faults in a row, and the camera is closed and opened again."""

    def __post_init__(self) -> None:
        for name in ("first_frame_s", "give_up_s", "backoff_s", "longest_backoff_s"):
            value = getattr(self, name)
            if value is None and name == "give_up_s":
                continue
            check_number(f"device.persistence.{name}", value, 0, above=True)
        check_number("device.persistence.reopen_after", self.reopen_after, 1, 1_000_000, whole=True)


def parse_id(text: str) -> tuple[int, int]:
    """Vendor and product of "1ad2:0074". Raises ToftrackError for anything else."""
    try:
        vendor, product = (int(part, 16) for part in text.split(":"))
    except ValueError:
        raise ToftrackError(
            f"device.usb.ids: '{text}' is not VENDOR:PRODUCT in hexadecimal, as 1ad2:0074"
        ) from None
    return vendor, product
