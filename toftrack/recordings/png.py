"""PNG images that others wrote, decoded by OpenCV only where the file is whole."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.safe_files import open_to_read

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_LARGEST_PIXELS = 64_000_000
"""A damaged header must not make us allocate gigabytes."""
_LENGTH, _SIZE = struct.Struct(">I"), struct.Struct(">II")


def read_png(path: Path, kind: type, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """An image of exactly that type and shape (colours in the order blue, green, red); None = of
    any size, without colours. ToftrackError when it cannot be read, is damaged, or of another kind.
    """
    with reported_errors(f"the image '{path}' cannot be read", "check its permissions"):
        with open_to_read(path) as stream:
            content = stream.read()
    image = decoded_png(content)
    if image is None:
        raise ToftrackError(f"the image '{path}' is damaged, or no PNG; copy or record it again")
    right_shape = image.ndim == 2 if shape is None else image.shape == shape
    if image.dtype != kind or not right_shape:
        size = "x".join(map(str, image.shape[1::-1] + image.shape[2:]))
        wanted = "grey" if shape is None else "x".join(map(str, shape[1::-1] + shape[2:]))
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
    if not 0 < width * height <= _LARGEST_PIXELS:
        return None
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
