"""A recording while it grows: `FILE.npz.part`, of which the `.npz` is made at its end.

After a line that says what it is, a block of JSON (the camera, what the images are, metadata), then
a record for each frame: its number, its time, and its images, each compressed by itself. Every
block and record ends with a checksum, so that what a kill or a power cut left unfinished is told
from what is whole. The images' pieces are such that one behind the other they are what a zip
archive holds: the `.npz` is made by copying them, without compressing anything again.
"""

from __future__ import annotations

import io
import json
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.archives import add_array
from toftrack.files.json_text import parse_json
from toftrack.files.safe_files import lock, open_in_place, open_new, whole_file, write_on
from toftrack.frames.camera import Camera
from toftrack.recordings.npz import camera_arrays

SUFFIX = ".part"
_FIRST_LINE = b"toftrack unfinished recording 1\n"
_BLOCK = struct.Struct("<II")
"""Bytes of the JSON, and its checksum."""
_RECORD = struct.Struct("<4sqdIIII")
_MARK = b"TOFR"
_CHECK = struct.Struct("<I")
_LARGEST_FACTS = 2**24
_PIECE_BYTES = 2**20
IMAGE_TYPES = ("<f4", "<u2")
"""Of depth and amplitude, as they are written."""
_LEVEL = 1
"""Of zlib; 6 takes three times as long for a tenth less."""
_END = zlib.compressobj(_LEVEL, wbits=-15).flush()
_POLYNOMIAL = 0xEDB88320
"""Of the CRC-32, the constant term in the highest bit."""


@dataclass(frozen=True)
class Facts:
    """What holds for all frames; amplitude: there are such images."""

    camera: Camera
    radial: bool
    amplitude: bool
    fps: float
    metadata: dict[str, Any]


@dataclass(frozen=True)
class _Kept:
    """A frame in the file.  at: where its pieces begin.  sizes, sums: bytes of each piece, and the
    checksum of all images of the kind so far, as they were before they were compressed.
    """

    index: int
    timestamp_s: float
    at: int
    sizes: Sequence[int]
    sums: Sequence[int]


class GrowingFile:
    """A new file that grows by whole records; each is the operating system's when `write` returns.

    replace: let a file that stands there go. ToftrackError where another process writes that.
    """

    def __init__(self, path: Path, replace: bool) -> None:
        if replace and path.exists():
            _locked(path).close()
        self.bytes = 0
        """What its whole records take."""
        # Without a buffer of Python's: what is written outlives the process.
        self.stream = open_new(path, replace, buffered=False)
        _lock(self.stream, path)

    def write(self, *parts: bytes) -> None:
        """Write a record. Raises OSError; the file then ends with the record before."""
        self.bytes = write_on(self.stream, self.bytes, *parts)

    def close(self) -> None:
        self.stream.close()


class UnfinishedRecording(GrowingFile):
    """A file that grows by frames."""

    def __init__(self, path: Path, replace: bool = False) -> None:
        self.path, self.frames = path, 0
        self._sums = [0, 0]
        super().__init__(path, replace)

    def begin(self, facts: Facts) -> None:
        """Write what holds for all frames."""
        content = json.dumps(vars(facts) | {"camera": facts.camera.to_dict()}).encode()
        self.write(_FIRST_LINE, _BLOCK.pack(len(content), zlib.crc32(content)), content)

    def append(self, index: int, timestamp_s: float, images: Sequence[bytes]) -> None:
        """Write a frame.  images: of each kind, the raw bytes and the `compressed` ones in turn."""
        sums = list(self._sums)
        for kind, raw in enumerate(images[::2]):
            sums[kind] = zlib.crc32(raw, sums[kind])
        pieces = images[1::2]
        sizes = [len(piece) for piece in pieces] + [0] * (2 - len(pieces))
        head = _RECORD.pack(_MARK, index, timestamp_s, *sizes, *sums)
        check = 0
        for part in (head, *pieces):
            check = zlib.crc32(part, check)
        self.write(head, *pieces, _CHECK.pack(check))
        self._sums, self.frames = sums, self.frames + 1


def finish(part: Path, path: Path, overwrite: bool = False) -> int:
    """Make the `.npz` of what is whole in a file that nobody writes any more; returns the frames.

    `part` goes, but stays with a ToftrackError: it is no such file, is being written, has no whole
    frame, or the recording exists (without `overwrite`) or cannot be written.
    """
    with reported_errors(
        f"the recording '{path}' cannot be made of '{part}', which is kept",
        f"make room, then `toftrack recover {part}`",
    ):
        with _locked(part) as stream:
            facts, frames = _read_facts(stream, part), list(_records(stream))
            if not frames:
                raise ToftrackError(f"'{part}' has no whole frame, so there is nothing to make")
            if not overwrite and os.path.lexists(path):
                raise ToftrackError(
                    f"the file '{path}' exists already, and '{part}' is another recording; rename "
                    f"one of them, or `toftrack recover {part} --replace`"
                )
            with whole_file(path) as target:
                _make_npz(target, stream, facts, frames)
        part.unlink()
    return len(frames)


def is_recording(path: Path) -> bool:
    """Whether a path is a recording's, finished or not, and no folder's."""
    return path.suffix.lower() in (".npz", ".srs", SUFFIX) and not path.is_dir()


def recover_recording(path: Path, overwrite: bool = False) -> tuple[Path, int]:
    """Finish what a recorder that was killed has left; returns the recording and its frames.
    path: FILE.npz, or the FILE.npz.part beside it.
    """
    part = path if path.suffix == SUFFIX else path.with_name(path.name + SUFFIX)
    if not os.path.lexists(part):
        raise ToftrackError(
            f"there is no '{part}', so there is nothing to recover; give what `toftrack record` or "
            "record=FILE left, FILE.npz.part (a .srs needs no recovery)"
        )
    target = part.with_name(part.name.removesuffix(SUFFIX))
    return target, finish(part, target, overwrite)


def _make_npz(target: BinaryIO, source: BinaryIO, facts: Facts, frames: Sequence[_Kept]) -> None:
    """Of the frames' pieces in `source`, which zipfile by itself would compress again."""
    camera = facts.camera
    shape = (len(frames), camera.height, camera.width)
    arrays: dict[str, Any] = {
        **camera_arrays(camera),
        "timestamp_s": np.array([frame.timestamp_s for frame in frames]),
        "index": np.array([frame.index for frame in frames], np.int64),
        "fps": np.float64(facts.fps),
        "metadata": json.dumps(facts.metadata),
    }
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        names = "radial_m" if facts.radial else "depth_m", "amplitude"
        for kind, name in enumerate(names[: 1 + facts.amplitude]):
            content = io.BytesIO()
            about = {"descr": IMAGE_TYPES[kind], "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(content, about)
            header = content.getvalue()
            head = compressed(header)
            image_bytes = math.prod(shape) * np.dtype(IMAGE_TYPES[kind]).itemsize
            entry = zipfile.ZipInfo(f"{name}.npy")
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o600 << 16
            entry.file_size = len(header) + image_bytes
            entry.compress_size = len(head) + sum(frame.sizes[kind] for frame in frames) + len(_END)
            entry.CRC = _joined_checksum(zlib.crc32(header), frames[-1].sums[kind], image_bytes)
            entry.header_offset = target.tell()
            target.write(entry.FileHeader(zip64=True) + head)
            for frame in frames:
                source.seek(frame.at + sum(frame.sizes[:kind]))
                for piece in _in_pieces(source, frame.sizes[kind]):
                    target.write(piece)
            target.write(_END)
            archive.filelist.append(entry)
            archive.NameToInfo[entry.filename] = entry
            archive.start_dir = target.tell()  # where the next member comes
        for name, value in arrays.items():
            add_array(archive, name, value)


def compressed(raw: bytes) -> bytes:
    """A piece of a deflated stream: one may follow the other."""
    deflate = zlib.compressobj(_LEVEL, zlib.DEFLATED, -15)
    return deflate.compress(raw) + deflate.flush(zlib.Z_FULL_FLUSH)


def _joined_checksum(first: int, second: int, length: int) -> int:
    """The CRC-32 of two texts, one behind the other, of their own and of the second's length."""
    shift, power = 1 << 31, 1 << 23  # one, and x^8, which appends a byte of zeros
    while length:
        if length & 1:
            shift = _product(shift, power)
        power, length = _product(power, power), length >> 1
    return _product(shift, first) ^ second


def _product(a: int, b: int) -> int:
    """Of two polynomials modulo the CRC's."""
    product = 0
    for bit in range(31, -1, -1):
        if a >> bit & 1:
            product ^= b
        b = b >> 1 ^ (_POLYNOMIAL if b & 1 else 0)
    return product


def _in_pieces(source: BinaryIO, size: int) -> Iterator[bytes]:
    """So many bytes from where a file stands."""
    while size:
        piece = source.read(min(size, _PIECE_BYTES))
        if not piece:
            raise OSError("it became shorter while it was read")
        size -= len(piece)
        yield piece


def _read_facts(stream: BinaryIO, path: Path) -> Facts:
    if stream.read(len(_FIRST_LINE)) != _FIRST_LINE:
        raise ToftrackError(
            f"'{path}' is no unfinished recording of toftrack's; give FILE.npz{SUFFIX}, or the "
            "output folder of a run"
        )
    try:
        length, check = _BLOCK.unpack(stream.read(_BLOCK.size))
        text = stream.read(min(length, _LARGEST_FACTS))
        if len(text) < length or zlib.crc32(text) != check:
            raise ValueError
        content = parse_json(text)
        camera = Camera.from_dict(content["camera"], path)
        kinds = bool(content["radial"]), bool(content["amplitude"])
        if not isinstance(content["metadata"], dict):
            raise TypeError
        return Facts(camera, *kinds, float(content["fps"]), content["metadata"])
    except (KeyError, TypeError, ValueError, struct.error):
        raise ToftrackError(
            f"'{path}' ends before its first frame, or its beginning is damaged"
        ) from None


def _records(stream: BinaryIO) -> Iterator[_Kept]:
    """The frames behind the facts, up to the last whole one."""
    end = os.fstat(stream.fileno()).st_size
    while len(head := stream.read(_RECORD.size)) == _RECORD.size:
        mark, index, timestamp_s, *sizes_and_sums = _RECORD.unpack(head)
        sizes, sums = sizes_and_sums[:2], sizes_and_sums[2:]
        at, check = stream.tell(), zlib.crc32(head)
        if mark != _MARK or at + sum(sizes) + _CHECK.size > end:
            return
        for piece in _in_pieces(stream, sum(sizes)):
            check = zlib.crc32(piece, check)
        if stream.read(_CHECK.size) != _CHECK.pack(check):
            return
        yield _Kept(index, timestamp_s, at, sizes, sums)


def _locked(path: Path) -> BinaryIO:
    """The file, opened for reading, and locked; OSError, and ToftrackError while somebody writes
    it.
    """
    raw = open_in_place(path, make=False)
    try:
        _lock(raw, path)
    except BaseException:
        raw.close()
        raise
    return cast(BinaryIO, io.BufferedReader(cast(io.RawIOBase, raw)))


def _lock(stream: IO[bytes] | io.RawIOBase, path: Path) -> None:
    try:
        lock(stream)
    except BlockingIOError:
        raise ToftrackError(
            f"'{path}' is being recorded just now; end that first, or choose another name"
        ) from None
