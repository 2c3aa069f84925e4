"""Long arrays of an `.npz` in pieces: compressed one behind the other, and read one by one."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Generator, Iterable
from pathlib import Path
from typing import BinaryIO

import numpy as np

from toftrack.archives import Archive, Header
from toftrack.errors import ToftrackError, reported_errors
from toftrack.safe_files import open_to_read

_LEVEL = 1
"""Of zlib; 6 takes three times as long for a tenth less."""
_END = zlib.compressobj(_LEVEL, wbits=-15).flush()
_POLYNOMIAL = 0xEDB88320
"""Of the CRC-32, the constant term in the highest bit."""


def compressed(raw: bytes) -> bytes:
    """A piece of a deflated stream: one may follow the other."""
    deflate = zlib.compressobj(_LEVEL, zlib.DEFLATED, -15)
    return deflate.compress(raw) + deflate.flush(zlib.Z_FULL_FLUSH)


def add_pieces(
    archive: zipfile.ZipFile,
    target: BinaryIO,
    name: str,
    shape: tuple[int, ...],
    kind: str,
    pieces: Iterable[bytes],
    size: int,
    checksum: int,
) -> None:
    """Add an array to an archive, which is written to the stream `target` and is not closed yet.

    zipfile by itself would compress it again.

    shape, kind: of the array; kind as `<f4`.
    pieces: of `compressed`, in order, or parts of such.
    size: bytes of all pieces.
    checksum: CRC-32 of the array's bytes.
    """
    content = io.BytesIO()
    header = {"descr": kind, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(content, header)
    head = compressed(content.getvalue())
    array_bytes = math.prod(shape) * np.dtype(kind).itemsize
    entry = zipfile.ZipInfo(f"{name}.npy")
    entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o600 << 16
    entry.file_size = len(content.getvalue()) + array_bytes
    entry.compress_size = len(head) + size + len(_END)
    entry.CRC = _joined_checksum(zlib.crc32(content.getvalue()), checksum, array_bytes)
    entry.header_offset = target.tell()
    target.write(entry.FileHeader(zip64=True))
    target.write(head)
    for piece in pieces:
        target.write(piece)
    target.write(_END)
    archive.filelist.append(entry)
    archive.NameToInfo[entry.filename] = entry
    archive.start_dir = target.tell()  # where the next member comes


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


class StreamedImages:
    """(T, H, W) images of one array of an archive, each to be had by its number.

    Made for going forward. An image before the latest one is found by beginning anew.

    Raises ToftrackError where the array cannot be read in turn, and later where it is damaged.
    """

    def __init__(self, path: Path, name: str, header: Header) -> None:
        self._path, self._name = path, name
        if header.fortran_order or header.kind.kind not in "fiu":
            raise ToftrackError(
                f"'{name}' of the recording '{path}' has {header.size / 1e9:.1f} GB, and can be "
                "read in turn only as numbers in C order; save it so (numpy.ascontiguousarray)"
            )
        self.shape, self.dtype, self.ndim = header.shape, header.kind, len(header.shape)
        self.size = int(np.prod(header.shape, dtype=object))
        self._images: Generator[np.ndarray] | None = None
        self._latest: tuple[int, np.ndarray] | None = None

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: int) -> np.ndarray:
        """(H, W), of the file's type."""
        if not 0 <= index < len(self):
            raise IndexError(index)
        if self._latest is None or index < self._latest[0]:
            self.close()
            self._images = self._in_turn()
        number, image = self._latest or (-1, np.empty(0))
        while number < index:
            assert self._images is not None
            number, image = number + 1, next(self._images)
            self._latest = number, image
        return image

    def close(self) -> None:
        """Close the file; the next image opens it again."""
        if self._images is not None:
            self._images.close()
        self._images = self._latest = None

    def _in_turn(self) -> Generator[np.ndarray]:
        shape = self.shape[1:]
        size = int(np.prod(shape)) * self.dtype.itemsize
        recording, remedy = f"the recording '{self._path}'", "copy or record it again"
        with (
            reported_errors(f"{recording} cannot be read", remedy),
            reported_errors(f"{recording} is damaged", remedy, ValueError),
            open_to_read(self._path) as file,
            Archive(file).rows(self._name) as stream,
        ):
            for _ in range(len(self)):
                content = stream.read(size)
                if len(content) < size:
                    raise ValueError(f"{self._name!r} is cut off")
                yield np.frombuffer(content, self.dtype).reshape(shape)


Images = np.ndarray | StreamedImages
"""(T, H, W) images, in memory or on the disk."""
