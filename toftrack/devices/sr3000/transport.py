"""What the ways to an SR3000 have in common: their faults and their settings.

A way has `check` (ToftrackError where it is plain, without opening it, that there is no camera),
`open` (ToftrackError where none can be found, claimed and configured), `acquire` (the FRAME_BYTES
bytes of a frame, or one of the faults below, within `patience_s`), `close`, which never raises, and
`facts` of the opened camera. Only one thread uses it at a time.

Every number below is a setting, because some of them were never tried against a camera: see
`conf/device/sr3000.yaml` for each one's unit and source.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from toftrack.errors import ToftrackError, check_number
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


@dataclass(frozen=True)
class Exposure:
    """How the camera is to take its images; see conf/device/sr3000.yaml."""

    modulation_mhz: int
    integration_time: int | None
    amplitude_threshold: int

    def __post_init__(self) -> None:
        unambiguous_range_m(self.modulation_mhz)
        if self.integration_time is not None:
            check_number("device.integration_time", self.integration_time, 0, 255, whole=True)
        check_number("device.amplitude_threshold", self.amplitude_threshold, 0, 0xFFFF, whole=True)

    @property
    def range_m(self) -> float:
        return unambiguous_range_m(self.modulation_mhz)

    @property
    def modulation_code(self) -> int:
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
    """The vendor's library; see conf/device/sr3000.yaml."""

    library: str
    mode: int
    timeout_ms: int

    def __post_init__(self) -> None:
        check_number("device.libmesasr.mode", self.mode, 0, 0x7FFFFFFF, whole=True)
        check_number("device.libmesasr.timeout_ms", self.timeout_ms, 1, 600_000, whole=True)


@dataclass(frozen=True)
class Persistence:
    """How long to go on trying; see conf/device/sr3000.yaml."""

    first_frame_s: float
    give_up_s: float | None
    """None = for ever."""
    backoff_s: float
    longest_backoff_s: float
    reopen_after: int

    def __post_init__(self) -> None:
        for name in ("first_frame_s", "give_up_s", "backoff_s", "longest_backoff_s"):
            if name != "give_up_s" or self.give_up_s is not None:
                check_number(f"device.persistence.{name}", getattr(self, name), 0, above=True)
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
