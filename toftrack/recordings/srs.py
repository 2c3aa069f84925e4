"""The vendor's stream file `.srs`: what the SR3000 delivered, frame by frame.

Little-endian words of 32 bits. Eight bytes of file header (signature, version), then objects, each
starting with its id and its size including these eight bytes:

| id | object | after the base |
| --- | --- | --- |
| 1 | Init, before any frame | product id, interface type, serial number |
| 2 | Configure, before the first frame, may recur | the 64 registers |
| 3 | Frame | one raw frame (`toftrack.recordings.sr_frame`) |
| 4 | CalibData, optional | the vendor's, not interpreted |

Unknown ids are skipped by their size. toftrack uses that for what the format has no place for: an
object "TOFT" (JSON: camera, range, frames a second, metadata) and before each frame an object
"TOFS" (one float64, the time stamp in seconds). Source of the format: the vendor's public files.
"""

from __future__ import annotations

import json
import os
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.json_text import parse_json
from toftrack.files.safe_files import open_to_read
from toftrack.frames.camera import Camera
from toftrack.recordings.frame_store import DEFAULT_FPS, FrameStore, file_of, rate_of, reading
from toftrack.recordings.sr_frame import (
    DEFAULT_MODULATION_MHZ,
    FRAME_BYTES,
    HEIGHT,
    REGISTERS,
    WIDTH,
    decode_frame,
    nominal_camera,
    unambiguous_range_m,
)
from toftrack.recordings.unfinished import GrowingFile

_SIGNATURE, _VERSION = 0x4F497273, 1
_INIT, _CONFIGURE, _FRAME = 1, 2, 3
_FACTS = int.from_bytes(b"TOFT", "little")
_STAMP = int.from_bytes(b"TOFS", "little")
_PAIR = struct.Struct("<II")
_THREE = struct.Struct("<III")
_SECONDS = struct.Struct("<d")
_HEAD = {_INIT: ("Init", _THREE.size), _CONFIGURE: ("Configure", REGISTERS)}
"""What must come before a frame, and how long it is; the first of each counts."""
_LARGEST_FACTS = 1 << 20  # bytes; a damaged size must not make us read a gigabyte as text


@dataclass(frozen=True)
class SrsInit:
    """Which camera made the recording."""

    product_id: int = 0x0074
    interface_type: int = 0
    serial_number: int = 0


@dataclass(frozen=True)
class SrsFacts:
    """What toftrack adds to the format; None = not stated."""

    range_m: float | None = None
    """What the largest distance word stands for."""
    camera: Camera | None = None
    fps: float = DEFAULT_FPS
    metadata: dict[str, Any] = field(default_factory=dict)


def _parse_facts(path: Path, text: bytes) -> SrsFacts:
    """What the content of a TOFT object says; `path` is for the message. Raises ToftrackError: what
    the recorder stated must not be replaced by a guess in silence.
    """
    try:
        content = parse_json(text)
        range_m, fps = content["range_m"], float(content["fps"])
        range_m = None if range_m is None else float(range_m)
        camera, metadata = content["camera"], content["metadata"]
        sensible = all(0 < number < np.inf for number in (fps, 1.0 if range_m is None else range_m))
        camera = None if camera is None else Camera.from_dict(camera, path)
        size = (WIDTH, HEIGHT) if camera is None else (camera.width, camera.height)
        if not sensible or not isinstance(metadata, dict) or size != (WIDTH, HEIGHT):
            raise ValueError
    except (ValueError, TypeError, KeyError, ToftrackError):
        raise ToftrackError(f"the TOFT object of the recording '{path}' is damaged") from None
    return SrsFacts(range_m, camera, fps, metadata)


def srs_head(init: SrsInit, registers: bytes, facts: SrsFacts) -> bytes:
    """What stands in a file before its frames."""
    numbers = (init.product_id, init.interface_type, init.serial_number)
    about = {
        "range_m": facts.range_m,
        "fps": facts.fps,
        "camera": facts.camera and facts.camera.to_dict(),
        "metadata": facts.metadata,
    }
    return (
        _PAIR.pack(_SIGNATURE, _VERSION)
        + _object(_INIT, _THREE.pack(*(n & 0xFFFFFFFF for n in numbers)))
        + _object(_FACTS, json.dumps(about).encode())
        + _object(_CONFIGURE, registers)
    )


def srs_frame(data: bytes, timestamp_s: float) -> bytes:
    """A raw frame as it stands in a file."""
    return _object(_STAMP, _SECONDS.pack(timestamp_s)) + _object(_FRAME, data)


class SrsWriter(GrowingFile):
    """Appends frames to a new `.srs` file, until `close`.

    Each frame reaches the operating system before `append` returns, so that a killed program leaves
    a file that is readable to its last whole frame.

    registers: the camera's 64 register bytes as far as they are known. Raises ToftrackError: the
    file exists already (without `overwrite`) or cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        init: SrsInit | None = None,
        registers: bytes = bytes(REGISTERS),
        facts: SrsFacts | None = None,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path).expanduser()
        self.frames = 0
        """Whole frames written."""
        if not overwrite and os.path.lexists(self.path):
            raise ToftrackError(
                f"the file '{self.path}' exists already; choose another name or give --overwrite"
            )
        what = f"the recording '{self.path}' cannot be written"
        with reported_errors(what, "choose another place"):
            super().__init__(self.path, overwrite)
        try:
            self._write(srs_head(init or SrsInit(), registers, facts or SrsFacts()))
        except BaseException:
            self.close()
            raise

    def append(self, data: bytes, timestamp_s: float) -> None:
        """Add a raw frame, FRAME_BYTES bytes, received at `timestamp_s`. ToftrackError when it
        cannot be written; the file then ends with the frame before.
        """
        self._write(srs_frame(data, timestamp_s))
        self.frames += 1

    def close(self) -> None:
        """Without a frame there is no file."""
        super().close()
        if not self.frames:
            self.path.unlink(missing_ok=True)

    def _write(self, content: bytes) -> None:
        what = f"the recording '{self.path}' cannot be written any further"
        kept = f"; its {self.frames} whole frames are kept" * bool(self.frames)
        with reported_errors(what, f"free some space{kept}"):
            self.write(content)


class SrsRecording(FrameStore):
    """The frames of a `.srs` file, read from the disk one at a time; its objects are checked when
    it is opened. One that is cut off or damaged somewhere is usable up to there (`damage` says so).

    modulation_mhz: tells the range of a recording that does not state it (the vendor's keep it in
    registers whose meaning is not public).
    """

    radial = True

    def __init__(self, path: Path, modulation_mhz: int = DEFAULT_MODULATION_MHZ) -> None:
        self.path, default_range_m = file_of(path), unambiguous_range_m(modulation_mhz)
        self._head: dict[int, bytes] = {}
        self._facts = SrsFacts()
        self._stream: BinaryIO | None = None
        self._offsets: list[int] = []
        """Where each frame's data begin."""
        self._stamps: list[float] = []
        """NaN for a frame without one."""
        with reading(self.path), open_to_read(self.path) as stream:
            self._scan(stream, os.fstat(stream.fileno()).st_size)
        if not self._offsets:
            reason = f" ({self.damage})" if self.damage else ""
            raise ToftrackError(
                f"the recording '{path}' has no whole frame{reason}; record it again"
            )
        self.init = SrsInit(*_THREE.unpack(self._head[_INIT]))
        self.registers = self._head[_CONFIGURE]
        facts, stamps = self._facts, np.array(self._stamps, np.float64)
        usable = np.isfinite(stamps).all() and (np.diff(stamps) >= 0).all()
        self.camera, self.metadata = facts.camera or nominal_camera(), facts.metadata
        self.range_m = facts.range_m or default_range_m
        self.timestamp_s = stamps if usable else np.arange(len(stamps)) / facts.fps
        self.fps = rate_of(self.timestamp_s, facts.fps)

    def raw(self, index: int) -> bytes:
        """A frame as the camera sent it, FRAME_BYTES bytes. Raises ToftrackError if unreadable."""
        with reading(self.path):
            if self._stream is None:
                self._stream = open_to_read(self.path)
            self._stream.seek(self._offsets[index])
            data = self._stream.read(FRAME_BYTES)
        if len(data) != FRAME_BYTES:
            raise ToftrackError(f"the recording '{self.path}' became shorter while it was read")
        return data

    def image(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        return decode_frame(self.raw(index), self.range_m)

    def close(self) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _scan(self, stream: BinaryIO, size: int) -> None:
        """Walk over the objects; ToftrackError where they break the format."""
        header = stream.read(_PAIR.size)
        signature, version = _PAIR.unpack(header.ljust(_PAIR.size, b"\0"))
        if signature != _SIGNATURE:
            raise ToftrackError(
                f"'{self.path}' is empty or not an .srs stream file: it does not begin with 'srIO';"
                " give a recording as the vendor's or toftrack's recorder writes it"
            )
        if version != _VERSION:
            raise ToftrackError(
                f"the stream file '{self.path}' has version {version}, but this toftrack reads "
                f"version {_VERSION}; convert it with the vendor's tools"
            )
        position, stamp = _PAIR.size, np.nan
        while position < size and self.damage is None:
            base = stream.read(_PAIR.size)
            if len(base) < _PAIR.size:
                self.damage = f"cut off at byte {position}"
                break
            kind, length = _PAIR.unpack(base)
            if length < _PAIR.size:
                self.damage = f"an object of {length} bytes at byte {position} makes no sense"
            elif position + length > size:
                self.damage = f"cut off in the object at byte {position}"
            elif kind == _STAMP and length == _PAIR.size + _SECONDS.size:
                (stamp,) = _SECONDS.unpack(stream.read(_SECONDS.size))
            elif kind == _FRAME:
                self._frame(position, length, stamp)
                stamp = np.nan
            else:
                self._other(kind, stream, length - _PAIR.size)
            position += length
            stream.seek(position)
        if self.damage is None and not np.isnan(stamp):
            self.damage = "cut off behind a time stamp"

    def _frame(self, position: int, length: int, stamp: float) -> None:
        for one, (name, _) in _HEAD.items():
            if one not in self._head:
                raise ToftrackError(
                    f"the recording '{self.path}' has a frame before its {name} object, which "
                    "breaks the format; record it again"
                )
        if length != _PAIR.size + FRAME_BYTES:
            self.damage = (
                f"the frame at byte {position} has {length - _PAIR.size} bytes instead of an "
                f"SR3000's {FRAME_BYTES}"
            )
            return
        self._offsets.append(position + _PAIR.size)
        self._stamps.append(stamp)

    def _other(self, kind: int, stream: BinaryIO, length: int) -> None:
        if kind in _HEAD and kind not in self._head:
            name, size = _HEAD[kind]
            if length != size:
                raise ToftrackError(
                    f"the {name} object of '{self.path}' is damaged; record it again"
                )
            self._head[kind] = stream.read(length)
        elif kind == _FACTS and length <= _LARGEST_FACTS:
            self._facts = _parse_facts(self.path, stream.read(length))


def _object(kind: int, content: bytes) -> bytes:
    return _PAIR.pack(kind, _PAIR.size + len(content)) + content
