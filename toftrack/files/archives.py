"""`.npz` archives: written in one way, and read with bounds, as they may come from strangers.

numpy's own reader allocates what a header claims, and Python's `zipfile` decompresses without
bounds what bzip2 or lzma packed. So headers are checked against the archive's directory first,
arrays that bzip2 packed, as most of our samples are, are read by `bz2`, which stops where it is
asked to, those of lzma are not read, pickled objects never are, and every way in which an archive
can be broken is a ValueError.
"""

from __future__ import annotations

import bz2
import copy
import errno
import io
import math
import struct
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from toftrack.files.safe_files import open_to_read, whole_file

MOST_BYTES = 2**30
"""An array of more than a gigabyte is not loaded."""
MOST_TEXT_BYTES = 2**26
"""Nor a text of more than 64 MB, nor so many texts: the names of a day's images take some."""
_MOST_RATIO, _SMALL_BYTES = 1000, 2**26
"""An array of more than a thousand times the archive was made to fill memories, unless it is small
anyway. Black amplitudes shrink as much; the depth images beside them to a tenth to a fortieth."""
_MOST_HEADER_BYTES = 2**16
_PIECE_BYTES = 2**20
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2)
_BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    RuntimeError,  # an encrypted member; an unknown compression; too deep a header
    SyntaxError,
    tokenize.TokenError,
    OverflowError,
    UnicodeError,
    TypeError,
)


class PickledError(ValueError):
    """An array is of Python objects, which could run code."""


@dataclass(frozen=True)
class Header:
    """What an array's header says, `offset` bytes long, checked against the archive's directory."""

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
            self._bytes = stream.seek(0, io.SEEK_END)
            stream.seek(0)
            self._zip = zipfile.ZipFile(stream)
            self._entries = {
                entry.filename.removesuffix(".npy"): entry for entry in self._zip.infolist()
            }
        self.names = tuple(self._entries)

    def header(self, name: str) -> Header:
        """An array's header, however large the array is."""
        with self._opened(name) as (_, header):
            return header

    def read(self, name: str, most_bytes: int | None = None) -> np.ndarray:
        """An array as a whole; of more than so many bytes, or a gigabyte, it is refused."""
        with self._opened(name) as (stream, header):
            _check_size(header.size, most_bytes)
            content = bytearray()
            while piece := stream.read(min(_PIECE_BYTES, header.size - len(content))):
                content += piece
            if len(content) < header.size:
                raise EOFError("it is shorter than the archive says")
            array = np.frombuffer(content, header.kind)
            if header.kind.kind == "U" and not _is_text(array):
                raise ValueError("its text is damaged")
            return array.reshape(header.shape, order="F" if header.fortran_order else "C")

    @contextmanager
    def rows(self, name: str) -> Iterator[IO[bytes]]:
        """The bytes of an array, after its header, to be read in turn."""
        with self._opened(name) as (stream, _):
            yield stream

    @contextmanager
    def _opened(self, name: str) -> Iterator[tuple[IO[bytes], Header]]:
        """The bytes of an array after its header, and that."""
        entry = self._entries[name]
        with broken_is_value_error(name):
            if entry.compress_type not in _METHODS:
                raise ValueError("its compression is unknown; save it with numpy.savez_compressed")
            bzip2 = entry.compress_type == zipfile.ZIP_BZIP2
            with self._zip.open(_as_packed(entry) if bzip2 else entry) as plain:
                stream = bz2.BZ2File(plain) if bzip2 else plain
                header = _header(stream)
                _check(header, entry, self._bytes)
                yield stream, header


def _as_packed(entry: zipfile.ZipInfo) -> zipfile.ZipInfo:
    """A member of which zipfile gives the bytes as they are packed."""
    packed = copy.copy(entry)
    packed.compress_type, packed.file_size = zipfile.ZIP_STORED, entry.compress_size
    del packed.CRC  # which is that of the unpacked ones
    return packed


def read_archive(
    path: str | Path, names: Collection[str] | None = None, most_bytes: int | None = None
) -> dict[str, np.ndarray]:
    """All arrays of an .npz file by name, or those of some names that are there; raises as
    `Archive`.  most_bytes: of all together; None = a gigabyte.
    """
    with open_to_read(path) as stream:
        archive = Archive(stream)
        wanted = [name for name in archive.names if names is None or name in names]
        _check_size(sum(archive.header(name).size for name in wanted), most_bytes)
        return {name: archive.read(name, most_bytes) for name in wanted}


@dataclass(frozen=True, eq=False)
class Pieces:
    """An array that is written in pieces, as its rows come, of that shape and type as a whole."""

    shape: tuple[int, ...]
    kind: np.dtype
    pieces: Iterable[np.ndarray]


def write_archive(path: str | Path, arrays: Mapping[str, Any], level: int | None = None) -> None:
    """Write an .npz file, compressed as `np.savez_compressed` does, by `whole_file`.

    arrays: whatever numpy makes numbers or text of, or `Pieces`, by name.
    level: of the compression, 0 to 9; None = zlib's own, 6.
    """
    with (
        whole_file(path) as target,
        zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=level) as archive,
    ):
        for name, array in arrays.items():
            add_array(archive, name, array)


def add_array(archive: zipfile.ZipFile, name: str, array: Any) -> None:
    """Write one more array, whatever numpy makes one of, or `Pieces`, into an open archive."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        if not isinstance(array, Pieces):
            np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
            return
        described = np.lib.format.dtype_to_descr(array.kind)
        header = {"descr": described, "fortran_order": False, "shape": array.shape}
        np.lib.format.write_array_header_1_0(member, header)
        for piece in array.pieces:
            member.write(piece.astype(array.kind, copy=False).tobytes())


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
        if error.errno not in (None, errno.EINVAL):
            raise
        # No stream of bzip2's; or the directory says that it lies before the file's beginning.
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


def _check_size(size: int, most_bytes: int | None) -> None:
    most = MOST_BYTES if most_bytes is None else most_bytes
    if size > most:
        raise ValueError(f"it is larger than {most / 1e9:.1f} GB")


def _check(header: Header, entry: zipfile.ZipInfo, packed: int) -> None:
    """ValueError for what no array is.  packed: bytes of the archive."""
    if min(header.shape, default=0) < 0 or header.offset + header.size != entry.file_size:
        raise ValueError("it is of another length than its header says")
    # A column of words is long where a run is.
    of_text = header.kind.itemsize, 4 * math.prod(header.shape)
    if header.kind.kind in "US" and max(of_text) > MOST_TEXT_BYTES:
        raise ValueError(f"it is text of {header.size / 1e6:.0f} MB")
    if entry.file_size > max(_SMALL_BYTES, _MOST_RATIO * packed):
        raise ValueError(f"it would unpack {packed} bytes to {entry.file_size / 1e6:.0f} MB")


def _is_text(array: np.ndarray) -> bool:
    """Whether all characters of texts (n,) are some; Python cannot make a string of others."""
    characters = array.view(np.dtype(np.uint32).newbyteorder(array.dtype.byteorder))
    return int(characters.max(initial=0)) <= sys.maxunicode
