"""Images that others wrote: PNG and TIFF, decoded by OpenCV; EXR, by OpenEXR of the extra `exr`.

What a file claims is checked before a decoder sees it: they allocate whatever that is.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from toftrack.errors import ToftrackError, module_of_extra, reported_errors
from toftrack.files.safe_files import open_to_read

SIGNATURE = b"\x89PNG\r\n\x1a\n"
LARGEST_PIXELS = 64_000_000
"""A damaged header must not make us allocate gigabytes."""
_LENGTH, _SIZE = struct.Struct(">I"), struct.Struct(">II")


def read_png(path: Path, kind: type, shape: tuple[int, ...]) -> np.ndarray:
    """An image of exactly that type and shape (colours in the order blue, green, red).
    ToftrackError when it cannot be read, is damaged, or of another kind.
    """
    with reported_errors(f"the image '{path}' cannot be read", "check its permissions"):
        with open_to_read(path) as stream:
            content = stream.read()
    image = decoded_png(content)
    if image is None:
        raise ToftrackError(f"the image '{path}' is damaged, or no PNG; copy or record it again")
    if image.dtype != kind or image.shape != shape:
        size, wanted = ("x".join(map(str, s[1::-1] + s[2:])) for s in (image.shape, shape))
        raise ToftrackError(
            f"the image '{path}' is {size} of {image.dtype}, but must be {wanted} of "
            f"{np.dtype(kind)}; all depth images must be of one size, 16-bit grey in steps of a "
            "millimetre, or as the data set's authors distribute them"
        )
    return image


def decoded_png(content: bytes) -> np.ndarray | None:
    """The image of a PNG file's bytes in its own type, colours in the order blue, green, red; None
    where they are damaged, cut off, or none of a PNG.
    """
    if not content.startswith(SIGNATURE) or not _whole(content):
        return None
    width, height = _SIZE.unpack_from(content, 16)
    if not 0 < width * height <= LARGEST_PIXELS:
        return None
    return decoded(content)


def decoded(content: bytes) -> np.ndarray | None:
    """What OpenCV makes of a file's bytes whose size was checked; None where they are damaged."""
    try:
        return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None


def _whole(content: bytes) -> bool:
    """Whether all chunks are there: the decoder allocates whatever length one claims, and fills up
    what was cut off."""
    at = len(SIGNATURE)
    # A chunk: its length, its kind, so many bytes, and a checksum.
    while at + 12 <= len(content):
        (length,) = _LENGTH.unpack_from(content, at)
        kind = content[at + 4 : at + 8]
        at += 12 + length
        if kind == b"IEND":
            return at <= len(content)
    return False


@dataclass(frozen=True)
class Page:
    """What a PNG, or an image of a TIFF, says of itself. kind: `u2` of 16 bits, and so on.

    at: where in the TIFF its directory is.
    """

    width: int
    height: int
    channels: int
    kind: str
    at: int = field(default=0, compare=False)

    @property
    def is_depth(self) -> bool:
        """It is grey, of 16 bits or floats."""
        return self.channels == 1 and self.kind in ("u2", "f4", "f8")


_TIFF = {b"II": "<", b"MM": ">"}
_TAGS = {256: 0, 257: 0, 258: 1, 277: 1, 339: 1, 322: 0, 323: 0}
"""Width, height, bits, channels, kind of number, a tile's width and height; and what holds where
they are not stated."""
_NUMBERS = {3: "H", 4: "I", 16: "Q"}
"""The kinds of values that decoders need of an image of 16 bits or floats."""
_PLACES, _SIZES = (273, 324), (279, 325)
"""Of strips, of tiles."""
_EXR = b"\x76\x2f\x31\x01"
_NOTHING_M = 1e10
"""What Blender says where nothing is seen."""


def pages_of(stream: IO[bytes]) -> list[Page]:
    """What the images of a PNG or TIFF say of themselves; none of other files. Raises ValueError
    where it is damaged, or an image larger than any camera's.
    """
    stream.seek(0)
    head = stream.read(26)
    try:
        if head.startswith(SIGNATURE):
            (width, height), bits, colours = _SIZE.unpack_from(head, 16), head[24], head[25]
            pages = [Page(width, height, 1 if colours == 0 else 3, f"u{bits // 8}")]
        elif head[:2] in _TIFF and head[2:4] in (b"*\0", b"\0*", b"+\0", b"\0+"):
            pages = _tiff_pages(stream, head)
        else:
            return []
    except (struct.error, IndexError, EOFError, OverflowError):
        raise ValueError("it is damaged or cut off") from None
    if not pages or not all(0 < page.width * page.height <= LARGEST_PIXELS for page in pages):
        raise ValueError("it is damaged, or larger than any camera's image")
    return pages


def _tiff_pages(stream: IO[bytes], head: bytes) -> list[Page]:
    """By the directories of a TIFF, or a BigTIFF, which are a list linked by their places."""
    order, place, count, entry = _layout(head)
    pages: dict[int, Page] = {}
    (at,) = place.unpack_from(head, place.size)
    while at:
        if at in pages:
            raise ValueError("its list of images has no end")
        stream.seek(at)
        (entries,) = count.unpack(stream.read(count.size))
        directory = stream.read(min(entries, 2**16) * entry.size + place.size)
        stated: dict[int, int] = {}
        for tag, kind, many, value in entry.iter_unpack(directory[: -place.size]):
            if tag in _TAGS:
                if tag in stated or kind not in (3, 4):  # decoders take the first, and other kinds
                    raise ValueError("it is damaged")
                (number,) = struct.unpack_from(order + "HI"[kind == 4], value)
                stated[tag] = number if many == 1 else _TAGS[tag]
        width, height, bits, channels, number, *tile = (_TAGS | stated).values()
        if tile[0] * tile[1] > LARGEST_PIXELS:
            raise ValueError("its tiles are larger than any camera's image")
        pages[at] = Page(width, height, channels, f"{'?uif'[number % 4]}{bits // 8}", at)
        (at,) = place.unpack(directory[-place.size :])
    return list(pages.values())


def _layout(head: bytes) -> tuple[str, struct.Struct, struct.Struct, struct.Struct]:
    """The order of a TIFF's bytes; and how a place, a count of entries, and an entry are packed."""
    order, big = _TIFF[head[:2]], b"+" in head[2:4]
    kinds = ("Q", "Q", "HHQ8s") if big else ("I", "H", "HHI4s")
    place, count, entry = (struct.Struct(order + kind) for kind in kinds)
    return order, place, count, entry


def tiff_of_page(stream: IO[bytes], page: Page) -> bytes:
    """A TIFF of one of a TIFF's images: OpenCV would read the directories of all before it. Raises
    ValueError where it is damaged.
    """
    end = stream.seek(0, io.SEEK_END)
    left = 2 * end  # a damaged one may name the same large part many times

    def read(at: int, size: int) -> bytes:
        nonlocal left
        left -= size
        if not 0 <= size <= end - at or left < 0:
            raise ValueError("it is damaged or cut off")
        stream.seek(at)
        return stream.read(size)

    def put(part: bytes) -> int:
        made.extend(part)
        return len(made) - len(part)

    made = bytearray(head := read(0, 16))
    order, place, count, entry = _layout(head)
    (many,) = count.unpack(read(page.at, count.size))
    entries = entry.iter_unpack(read(page.at + count.size, many * entry.size))
    directory, sizes = b"", list[int]()
    for tag, kind, many, value in sorted(entries, reverse=True):  # sizes, and then their places
        if kind not in _NUMBERS:
            continue
        form = struct.Struct(f"{order}{many}{_NUMBERS[kind]}")
        if form.size > place.size:
            value = read(place.unpack(value)[0], form.size)
        numbers = list(form.unpack_from(value))
        if tag in _SIZES:
            sizes = numbers
        elif tag in _PLACES:
            if many == 1 and numbers[0]:  # its size may be wrong, or left out
                most = 2 * page.width * page.height * int(page.kind[1:])
                sizes = [min(end - numbers[0], max([most, *sizes]))]
            numbers = [put(read(*piece)) for piece in zip(numbers, sizes, strict=False)]
            kind, many = 16 if place.size == 8 else 4, len(numbers)
        value = struct.pack(f"{order}{many}{_NUMBERS[kind]}", *numbers)
        if len(value) > place.size:
            value = place.pack(put(value))
        directory = entry.pack(tag, kind, many, value) + directory
    directory = count.pack(len(directory) // entry.size) + directory + place.pack(0)
    place.pack_into(made, place.size, put(directory))
    return bytes(made)


def decoded_depth(content: bytes) -> np.ndarray:
    """A depth image, (H, W) uint16 or float32, of the bytes of a PNG, TIFF or EXR. Raises
    ValueError, a few words, for what is damaged or no depth; ToftrackError without OpenEXR.
    """
    if content.startswith(_EXR):
        return _decoded_exr(content)
    pages = pages_of(io.BytesIO(content))
    image = None
    if pages and not pages[0].is_depth:
        channels, kind = pages[0].channels, pages[0].kind
        raise ValueError(f"it has {channels} channel(s) of {kind}, not one of 16 bits or floats")
    if content.startswith(SIGNATURE):
        image = decoded_png(content)
    elif len(pages) > 1 and len(set(pages)) == 1:
        raise ValueError(f"it is a stack of {len(pages)} images: give it by itself")
    elif pages:
        image = decoded(content)
    if image is None or image.ndim != 2:
        raise ValueError("it is damaged, or of another kind than its name says")
    return image if image.dtype == np.uint16 else image.astype(np.float32)


def _decoded_exr(content: bytes) -> np.ndarray:
    # Not by its older InputFile, which damaged files crash.
    library = module_of_extra("OpenEXR", "EXR images are read by OpenEXR", "exr")
    try:
        parts = library.File(io.BytesIO(content), header_only=True).parts
        values = 0  # the library decodes all channels of all parts
        for part in reversed(parts):
            low, high = part.header["dataWindow"]
            width, height = (int(value) for value in high.astype(np.int64) - low + 1)
            values += width * height * len(part.header["channels"])
            if min(width, height) < 1 or values > LARGEST_PIXELS:
                raise ValueError("it is damaged, or larger than any camera's image")
        channels = library.File(io.BytesIO(content), separate_channels=True).channels()
        read = [channels[name].pixels for name in _depth_channels(list(channels))]
    except (OSError, RuntimeError, TypeError, KeyError, MemoryError) as error:
        raise ValueError(f"it is damaged: {error}") from None
    if read[0].shape != (height, width):
        raise ValueError("it is damaged")
    if not all(np.array_equal(one, read[0], equal_nan=True) for one in read):
        raise ValueError("it is a colour image")
    depth = read[0].astype(np.float32)
    return np.where(depth < _NOTHING_M, depth, np.float32(0))


def _depth_channels(names: list[str]) -> list[str]:
    """Where an EXR's depth is: a channel, or three that must be equal, as programs write grey."""
    layer = [name for name in names if "depth" in name.lower()] or names
    plain = {name.rpartition(".")[2].upper(): name for name in layer}
    for name in ("Z", "V", "Y", "DEPTH"):
        if name in plain:
            return [plain[name]]
    if {"R", "G", "B"} <= plain.keys():
        return [plain[name] for name in "RGB"]
    if len(layer) == 1:
        return layer
    raise ValueError(f"which of its channels is the depth is not clear: {', '.join(names)}")
