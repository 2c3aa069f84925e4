"""`.npz` archives that others wrote: what is claimed is checked before and while it is read.

Python's own reader decompresses as much as a piece of the file makes, which of bzip2 can be
gigabytes from kilobytes, and numpy's allocates what a header claims. Here both are bounded, pickled
objects are never loaded, and every way in which an archive can be broken is a ValueError.
"""

from __future__ import annotations

import bz2
import copy
import errno
import io
import lzma
import math
import struct
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Protocol

import numpy as np

from toftrack.safe_files import open_to_read

MOST_BYTES = 2**30
"""An array of more than a gigabyte is not loaded."""
MOST_TEXT_BYTES = 2**24
"""Nor a text of more than 16 MB: a page of JSON is some kilobytes."""
_MOST_RATIO, _SMALL_BYTES = 1000, 2**26
"""What shrank to less than a thousandth was made to fill memories, unless it is small anyway;
depth and amplitude images of real cameras shrink to a tenth to a fortieth."""
_MOST_HEADER_BYTES = 2**16
_MOST_DICTIONARY_BYTES = 2**26
_PIECE_BYTES = 2**16
_BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    RuntimeError,  # an encrypted member; an unknown compression; too deep a header
    SyntaxError,
    tokenize.TokenError,
    OverflowError,
    MemoryError,
    UnicodeError,
    TypeError,
)


class PickledError(ValueError):
    """An array is of Python objects, which could run code."""


@dataclass(frozen=True)
class Header:
    """What an array's header says, checked against the size that the archive states.

    offset: bytes of the header itself.
    """

    shape: tuple[int, ...]
    kind: np.dtype
    fortran_order: bool
    offset: int

    @property
    def size(self) -> int:
        """Bytes of the array."""
        return math.prod(self.shape) * self.kind.itemsize


class Archive:
    """An open `.npz`: the names of its arrays, their headers, the arrays, or their bytes in turn.

    Every method raises ValueError, a few words, for what is damaged, too large or pickled, and
    OSError for what cannot be read.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        with broken_is_value_error():
            if not zipfile.is_zipfile(stream):
                raise ValueError("it is no .npz archive, or cut off")
            stream.seek(0)
            self._zip = zipfile.ZipFile(stream)
            self._entries = {
                entry.filename.removesuffix(".npy"): entry for entry in self._zip.infolist()
            }

    @property
    def names(self) -> tuple[str, ...]:
        """Of all arrays."""
        return tuple(self._entries)

    def header(self, name: str, most_bytes: int | None = MOST_BYTES) -> Header:
        """An array's header; most_bytes: larger arrays are refused, None: none is."""
        with broken_is_value_error(name), self._open(name) as stream:
            header = _header(stream)
            _check(name, header, self._entries[name], most_bytes)
            return header

    def read(self, name: str, most_bytes: int = MOST_BYTES) -> np.ndarray:
        """An array as a whole."""
        with broken_is_value_error(name), self._open(name) as stream:
            header = _header(stream)
            _check(name, header, self._entries[name], most_bytes)
            content = bytearray(header.size)
            if _fill(stream, memoryview(content)) < header.size or stream.read(1):
                raise ValueError("it is of another length than its header says")
            array = np.frombuffer(content, header.kind)
            if header.kind.kind == "U" and not _is_text(array):
                raise ValueError("its text is damaged")
            return array.reshape(header.shape, order="F" if header.fortran_order else "C")

    @contextmanager
    def rows(self, name: str) -> Iterator[IO[bytes]]:
        """The bytes of an array, after its header, to be read in turn."""
        with broken_is_value_error(name), self._open(name) as stream:
            _check(name, _header(stream), self._entries[name], None)
            yield stream

    def close(self) -> None:
        self._zip.close()

    def _open(self, name: str) -> IO[bytes]:
        return io.BufferedReader(_Member(self._zip, self._entries[name]), _PIECE_BYTES)


def read_archive(path: str | Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """All arrays of an .npz file by name, or those of some names that are there.

    Raises FileNotFoundError; another OSError when it cannot be read; ValueError, saying in few
    words why, when it is no .npz archive, is cut off or damaged, too large to be meant, or holds
    pickled objects.
    """
    with open_to_read(path) as stream:
        archive = Archive(stream)
        wanted = [name for name in archive.names if names is None or name in names]
        if sum(archive.header(name).size for name in wanted) > MOST_BYTES:
            raise ValueError(f"it is larger than {MOST_BYTES / 1e9:.1f} GB")
        return {name: archive.read(name) for name in wanted}


@contextmanager
def broken_is_value_error(name: str | None = None) -> Iterator[None]:
    """Every way in which an archive, or its array of that name, can be broken is a ValueError."""
    where = "the archive" if name is None else f"{name!r}"
    try:
        yield
    except MemoryError:
        raise ValueError(f"{where} needs more memory than there is") from None
    except _BROKEN as error:
        raise ValueError(f"{where} is damaged: {str(error) or type(error).__name__}") from None
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
        # The directory says that something lies before the file's beginning.
        raise ValueError(f"{where} is damaged: it is not where it should be") from None
    except PickledError:
        raise PickledError(f"{where} holds pickled objects, not numbers") from None
    except ValueError as error:
        raise ValueError(str(error) if name is None else f"{where}: {error}") from None


def _header(stream: IO[bytes]) -> Header:
    """Read an array's header; numpy would first allocate whatever length it claims."""
    start = stream.read(8)
    if len(start) < 8 or start[:6] != b"\x93NUMPY" or start[6] not in (1, 2, 3):
        raise ValueError("it is no array")
    version = (start[6], start[7])
    counted = stream.read(2 if start[6] == 1 else 4)
    length = int.from_bytes(counted, "little")
    if length > _MOST_HEADER_BYTES:
        raise ValueError("its header is damaged")
    rest = stream.read(length)
    read = np.lib.format.read_array_header_1_0
    if version != (1, 0):
        read = np.lib.format.read_array_header_2_0
    shape, fortran_order, kind = read(io.BytesIO(counted + rest))
    if kind.hasobject:
        raise PickledError
    return Header(shape, kind, fortran_order, 8 + len(counted) + length)


def _check(name: str, header: Header, entry: zipfile.ZipInfo, most_bytes: int | None) -> None:
    if min(header.shape, default=0) < 0 or header.offset + header.size != entry.file_size:
        raise ValueError("it is of another length than its header says")
    if most_bytes is not None and header.size > most_bytes:
        raise ValueError(
            f"it has {header.size / 1e9:.2g} GB, and at most {most_bytes / 1e9:.2g} are read"
        )
    if header.kind.kind in "US" and header.size > MOST_TEXT_BYTES:
        raise ValueError(f"it is a text of {header.size / 1e6:.0f} MB")
    if entry.file_size > max(_SMALL_BYTES, _MOST_RATIO * entry.compress_size):
        raise ValueError(
            f"it would make {entry.file_size / 1e6:.0f} MB of {entry.compress_size} bytes"
        )


def _is_text(array: np.ndarray) -> bool:
    """Whether all characters of texts (n,) are some; Python cannot make a string of others."""
    characters = array.view(np.dtype(np.uint32).newbyteorder(array.dtype.byteorder))
    return int(characters.max(initial=0)) <= sys.maxunicode


def _fill(stream: IO[bytes], target: memoryview) -> int:
    """Read until the target is full or nothing comes any more; how much there was."""
    done = 0
    while done < len(target):
        piece = stream.read(min(2**20, len(target) - done))
        if not piece:
            break
        target[done : done + len(piece)] = piece
        done += len(piece)
    return done


class _Decompressor(Protocol):
    """Makes at most so many bytes at a time, as those of bz2 and lzma do."""

    @property
    def needs_input(self) -> bool: ...

    @property
    def eof(self) -> bool: ...

    def decompress(self, data: bytes, max_length: int, /) -> bytes: ...


class _Member(io.RawIOBase):
    """A member's bytes, decompressed in pieces of at most what is asked for, its checksum tested.

    Ends with the size that the archive states; what would come after it is not made.
    """

    def __init__(self, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> None:
        # Read as if it were stored: the bytes as they lie in the file, of which there are as many.
        raw = copy.copy(entry)
        raw.compress_type, raw.file_size = zipfile.ZIP_STORED, entry.compress_size
        del raw.CRC
        self._raw = archive.open(raw)
        self._left, self._crc, self._wanted_crc = entry.file_size, 0, entry.CRC
        self._decompressor = _decompressor(entry.compress_type, self._raw)

    def readable(self) -> bool:
        return True

    def readinto(self, target: bytearray | memoryview) -> int:  # type: ignore[override]
        data = self._some(min(len(target), self._left))
        target[: len(data)] = data
        self._crc = zlib.crc32(data, self._crc)
        self._left -= len(data)
        if not self._left and self._crc != self._wanted_crc:
            raise zipfile.BadZipFile("its checksum is wrong")
        return len(data)

    def _some(self, count: int) -> bytes:
        """Up to so many bytes; none only at the end."""
        while count:
            hungry = self._decompressor.needs_input
            source = self._raw.read(_PIECE_BYTES) if hungry else b""
            try:
                data = self._decompressor.decompress(source, count)
            except OSError:  # bz2's way to say so
                raise zipfile.BadZipFile("its data are damaged") from None
            if data:
                return data
            if self._decompressor.eof or (hungry and not source):
                raise EOFError("it is shorter than the archive says")
        return b""

    def close(self) -> None:
        self._raw.close()
        super().close()


def _decompressor(method: int, raw: IO[bytes]) -> _Decompressor:
    if method == zipfile.ZIP_STORED:
        return _Stored()
    if method == zipfile.ZIP_DEFLATED:
        return _Inflate()
    if method == zipfile.ZIP_BZIP2:
        return bz2.BZ2Decompressor()
    if method == zipfile.ZIP_LZMA:
        return _lzma(raw)
    raise ValueError(f"it is compressed in an unknown way ({method})")


class _Stored:
    """What is not compressed."""

    eof = False

    def __init__(self) -> None:
        self._rest = b""

    @property
    def needs_input(self) -> bool:
        return not self._rest

    def decompress(self, data: bytes, max_length: int, /) -> bytes:
        data, self._rest = self._rest + data, b""
        data, self._rest = data[:max_length], data[max_length:]
        return data


class _Inflate:
    """zlib's decompressor with the face of bz2's."""

    def __init__(self) -> None:
        self._inflate = zlib.decompressobj(-15)

    @property
    def eof(self) -> bool:
        return self._inflate.eof

    @property
    def needs_input(self) -> bool:
        return not self._inflate.unconsumed_tail

    def decompress(self, data: bytes, max_length: int, /) -> bytes:
        return self._inflate.decompress(self._inflate.unconsumed_tail + data, max_length)


def _lzma(raw: IO[bytes]) -> lzma.LZMADecompressor:
    """Of a zip's kind: two bytes version, the length of the properties, and these five."""
    start = raw.read(9)
    if len(start) < 9 or start[2:4] != b"\x05\x00" or start[4] >= 9 * 5 * 5:
        raise ValueError("its lzma properties are damaged")
    (rest, lc), dictionary = divmod(start[4], 9), int.from_bytes(start[5:], "little")
    if dictionary > _MOST_DICTIONARY_BYTES:
        raise ValueError(f"its lzma dictionary would have {dictionary / 1e6:.0f} MB")
    kind = {"id": lzma.FILTER_LZMA1, "lc": lc, "lp": rest % 5, "pb": rest // 5}
    return lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=[kind | {"dict_size": dictionary}])
