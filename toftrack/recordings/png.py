"""PNG images that others wrote, decoded only where the file is whole."""

from __future__ import annotations

import struct

import cv2
import numpy as np

SIGNATURE = b"\x89PNG\r\n\x1a\n"
LARGEST_PIXELS = 64_000_000
"""A damaged header must not make us allocate gigabytes."""
_LENGTH, _SIZE = struct.Struct(">I"), struct.Struct(">II")


def decoded_png(content: bytes) -> np.ndarray | None:
    """The image of a PNG file's bytes in its own type, colours in the order blue, green, red.

    None where they are damaged, cut off, or none of a PNG.
    """
    if not content.startswith(SIGNATURE) or not _whole(content):
        return None
    width, height = _SIZE.unpack_from(content, 16)
    if not 0 < width * height <= LARGEST_PIXELS:
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
