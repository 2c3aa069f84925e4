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
import os
import shutil
import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import numpy as np

from toftrack.archives import add_array
from toftrack.camera import Camera
from toftrack.errors import ToftrackError, reported_errors
from toftrack.json_text import parse_json
from toftrack.recordings.npz import camera_arrays
from toftrack.recordings.npz_pieces import add_pieces
from toftrack.safe_files import lock, open_in_place, open_new, whole_file

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


@dataclass(frozen=True)
class Facts:
    """What holds for all frames.

    radial: the depth is the distance along each pixel's ray.  amplitude: there are such images.
    metadata: JSON-able.
    """

    camera: Camera
    radial: bool
    amplitude: bool
    fps: float
    metadata: dict[str, Any]

    @property
    def image_names(self) -> tuple[str, ...]:
        """Of the arrays of images in the `.npz`, in the order of the pieces of a record."""
        return ("radial_m" if self.radial else "depth_m", "amplitude")[: 1 + self.amplitude]


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

    Raises OSError: something stands there, or it cannot be made.
    """

    def __init__(self, path: Path, replace: bool) -> None:
        self.bytes = 0
        """What its whole records take."""
        # Without a buffer of Python's: what is written outlives the process.
        self.stream = open_new(path, replace, buffered=False)

    def write(self, *parts: bytes) -> None:
        """Write a record. Raises OSError; the file then ends with the record before."""
        try:
            for part in parts:
                rest = memoryview(part)
                while rest:  # a disk that is nearly full takes a part
                    rest = rest[self.stream.write(rest) :]
        except OSError:
            with suppress(OSError):  # whoever reads it copes with a record that is cut off
                self.stream.truncate(self.bytes)
                self.stream.seek(self.bytes)
            raise
        self.bytes += sum(map(len, parts))

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self.stream.close()


class UnfinishedRecording(GrowingFile):
    """A file that grows by frames.

    path: of the new file.
    replace: let a file that stands there go.

    Raises ToftrackError: another process writes the file (with `replace`).
    Raises OSError: the file exists, or cannot be made, or (by `begin` and `append`) not be written;
    then it ends with the frame before.
    """

    def __init__(self, path: Path, replace: bool = False) -> None:
        if replace and path.exists():
            _locked(path).close()
        self.path, self.frames = path, 0
        self._sums = [0, 0]
        super().__init__(path, replace)
        _lock(self.stream, path)

    def begin(self, facts: Facts) -> None:
        """Write what holds for all frames."""
        content = json.dumps(
            {
                "camera": facts.camera.to_dict(),
                "radial": facts.radial,
                "amplitude": facts.amplitude,
                "fps": facts.fps,
                "metadata": facts.metadata,
            }
        ).encode()
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

    def has_space(self, spare_bytes: int) -> bool:
        """Whether the disk would take the `.npz`, too, and leave so much to others."""
        return shutil.disk_usage(self.path.parent).free > self.bytes + spare_bytes


def finish(part: Path, path: Path, overwrite: bool = False) -> int:
    """Make the `.npz` of what is whole in a file that grew, which goes; returns the frames.

    part: the file, which nobody writes any more.
    path: of the recording.
    overwrite: replace an existing one.

    Raises ToftrackError: it is no such file, is being written, has no whole frame, or the recording
    exists or cannot be written; the file then stays.
    """
    with reported_errors(
        f"the recording '{path}' cannot be made of '{part}', which is kept",
        f"make room, then `toftrack recover {part}`",
    ):
        with _locked(part) as stream:
            facts, frames = _read(stream, part)
            if not frames:
                raise ToftrackError(f"'{part}' has no whole frame, so there is nothing to make")
            if not overwrite and os.path.lexists(path):
                raise ToftrackError(
                    f"the file '{path}' exists already, and '{part}' is another recording; rename "
                    "one of them, or give --replace"
                )
            with whole_file(path) as target:
                _make_npz(target, stream, facts, frames)
        part.unlink()
    return len(frames)


def is_recording(path: Path) -> bool:
    """Whether a path is a recording's, finished or not, and no folder's."""
    return path.suffix.lower() in (".npz", ".srs", SUFFIX) and not path.is_dir()


def recover_recording(path: Path, overwrite: bool = False) -> tuple[Path, int]:
    """Finish what a recorder that was killed has left.

    path: FILE.npz, or the FILE.npz.part beside it.  overwrite: replace FILE.npz.

    Returns the recording and its frames. Raises ToftrackError as `finish`, and where there is
    nothing that was left.
    """
    part = path if path.suffix == SUFFIX else path.with_name(path.name + SUFFIX)
    if not os.path.lexists(part):
        raise ToftrackError(
            f"there is no '{part}', so there is nothing to recover; give what `toftrack record` or "
            "record=FILE left, FILE.npz.part (a .srs needs nothing)"
        )
    target = part.with_name(part.name.removesuffix(SUFFIX))
    return target, finish(part, target, overwrite)


def _make_npz(target: BinaryIO, source: BinaryIO, facts: Facts, frames: Sequence[_Kept]) -> None:
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
        for kind, name in enumerate(facts.image_names):
            pieces = _pieces(source, frames, kind)
            size = sum(frame.sizes[kind] for frame in frames)
            checksum = frames[-1].sums[kind]
            add_pieces(archive, target, name, shape, IMAGE_TYPES[kind], pieces, size, checksum)
        for name, value in arrays.items():
            add_array(archive, name, value)


def _pieces(source: BinaryIO, frames: Sequence[_Kept], kind: int) -> Iterator[bytes]:
    """Of all frames, the pieces of one kind of image."""
    for frame in frames:
        source.seek(frame.at + sum(frame.sizes[:kind]))
        yield from _in_pieces(source, frame.sizes[kind])


def _in_pieces(source: BinaryIO, size: int) -> Iterator[bytes]:
    """So many bytes from where a file stands."""
    while size:
        piece = source.read(min(size, _PIECE_BYTES))
        if not piece:
            raise OSError("it became shorter while it was read")
        size -= len(piece)
        yield piece


def _read(stream: BinaryIO, path: Path) -> tuple[Facts, list[_Kept]]:
    """What a file holds, up to the last whole frame."""
    stream.seek(0)
    if stream.read(len(_FIRST_LINE)) != _FIRST_LINE:
        raise ToftrackError(
            f"'{path}' is no unfinished recording of toftrack's; give FILE.npz{SUFFIX}, or the "
            "output folder of a run"
        )
    return _read_facts(stream, path), list(_records(stream))


def _read_facts(stream: BinaryIO, path: Path) -> Facts:
    try:
        length, check = _BLOCK.unpack(stream.read(_BLOCK.size))
        text = stream.read(min(length, _LARGEST_FACTS))
        if len(text) < length or zlib.crc32(text) != check:
            raise ValueError
        content = parse_json(text)
        if not isinstance(content["metadata"], dict):
            raise TypeError
        return Facts(
            camera=Camera.from_dict(content["camera"], path),
            radial=bool(content["radial"]),
            amplitude=bool(content["amplitude"]),
            fps=float(content["fps"]),
            metadata=content["metadata"],
        )
    except (KeyError, TypeError, ValueError, struct.error):
        raise ToftrackError(
            f"'{path}' ends before its first frame, or its beginning is damaged"
        ) from None


def _records(stream: BinaryIO) -> Iterator[_Kept]:
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
    """The file, opened for reading, and locked.

    Raises OSError, and ToftrackError while somebody writes it.
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
