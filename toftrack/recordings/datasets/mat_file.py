"""Numeric arrays out of MATLAB's files of version 5 to 7, compressed or not.

A reader of its own because SciPy's can crash the process on a damaged file. A file is a header of
128 bytes and a row of elements, each a tag (type and number of bytes) and data, padded to 8 bytes.
An array is an element made of elements: flags, size, name, real part, imaginary part.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.recordings.datasets.base import read_bytes

_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
"""NumPy's kind of each type of element that holds numbers."""
_NUMERIC_CLASSES = range(6, 16)
_COMPLEX = 0x0800
_PEEK = 4096
"""So much of a compressed array holds its name for certain: names have at most 63 letters."""


class _DamagedError(Exception):
    """What is wrong, without the file's name."""


def read_numbers(path: Path, name: str) -> np.ndarray:
    """A real numeric array by its name, in its own type.

    Raises:
        ToftrackError: the file cannot be read, is damaged or of another version, or has no such
            array.
    """
    try:
        return _find(memoryview(read_bytes(path)), name)
    except _DamagedError as error:
        raise ToftrackError(
            f"the file '{path}' cannot be used ({error}); copy the data set again"
        ) from None


def _find(content: memoryview, name: str) -> np.ndarray:
    order = {b"IM": "<", b"MI": ">"}.get(bytes(content[126:128]))
    if order is None:
        raise _DamagedError("it is no file of MATLAB's")
    if content[125 if order == "<" else 124] != 1:
        raise _DamagedError("its version is not 5, 6 or 7; save it anew with -v7")
    for kind, data in _elements(content[_HEADER:], order):
        if kind == _COMPRESSED and _name_of(_inflated(data, _PEEK), order) == name:
            kind, data = next(_elements(memoryview(_inflated(data)), order), (0, data))
        if kind == _MATRIX:
            found, array = _array(data, order, name)
            if found == name:
                return array
    raise _DamagedError(f"it has no array named {name}")


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """(type, data) of each element in a row of them."""
    at = 0
    while at < len(content):
        if len(content) - at < 8:
            raise _DamagedError("it is cut off")
        kind, size = (int(word) for word in np.frombuffer(content[at : at + 8], f"{order}u4"))
        begin, step = at + 8, 8
        if kind >> 16:  # a small element: size, type and data in one tag
            kind, size = kind & 0xFFFF, kind >> 16
            begin, step = at + 4, 4
        elif kind == _COMPRESSED:
            step = 1
        if begin + size > len(content):
            raise _DamagedError("it is cut off")
        yield kind, content[begin : begin + size]
        at = begin + math.ceil(size / step) * step


def _inflated(data: memoryview, most: int = 0) -> bytes:
    """A compressed element, or its first `most` bytes."""
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(data, most)
    except (zlib.error, MemoryError) as error:
        raise _DamagedError(str(error) or "it is too large") from None
    if not most and not stream.eof:
        raise _DamagedError("it is cut off")
    return content


def _name_of(beginning: bytes, order: str) -> str | None:
    """The name of an array of which only the beginning is there; None: it is no array."""
    kind, _ = np.frombuffer(beginning[:8], f"{order}u4") if len(beginning) >= 8 else (0, 0)
    if kind != _MATRIX:
        return None
    parts = _elements(memoryview(beginning)[8:], order)
    try:
        _flags, _size, (_, letters) = next(parts), next(parts), next(parts)
    except (StopIteration, _DamagedError):
        return None
    return bytes(letters).decode("latin-1")


def _array(content: memoryview, order: str, name: str) -> tuple[str | None, np.ndarray]:
    """(its name, the array); an array of another name is not read."""
    nothing = np.empty(0)
    parts = _elements(content, order)
    try:
        (_, flags), (_, size), (_, letters) = next(parts), next(parts), next(parts)
        found = bytes(letters).decode("latin-1")
        if found != name:
            return found, nothing
        kind, numbers = next(parts)
    except StopIteration:
        return None, nothing
    if len(flags) < 4 or len(size) % 4:
        raise _DamagedError(f"{name} is damaged")
    word = int(np.frombuffer(flags[:4], f"{order}u4")[0])
    if (word & 0xFF) not in _NUMERIC_CLASSES or word & _COMPLEX or kind not in _NUMBERS:
        raise _DamagedError(f"{name} does not consist of real numbers")
    shape = np.frombuffer(size, f"{order}i4").tolist()
    values = np.dtype(order + _NUMBERS[kind])
    if min(shape, default=-1) < 0 or math.prod(shape) * values.itemsize != len(numbers):
        raise _DamagedError(f"{name} has another size than it says")
    return found, np.frombuffer(numbers, values).reshape(shape, order="F")
