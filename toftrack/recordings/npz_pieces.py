"""Arrays of an `.npz` of which pieces are compressed already, one behind the other."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Iterable
from typing import BinaryIO

import numpy as np

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
