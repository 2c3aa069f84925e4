"""ROS's messages: `Image` and `CompressedImage` of sensor_msgs to metres, `CameraInfo` to a lens.

REP 118: `16UC1` counts millimetres, 0 = no reading; `32FC1` is metres, NaN or infinity = no
reading. Of compressed ones those without loss are read: `compressedDepth` (a header of 12 bytes,
then a PNG or RVL; of 32FC1 these hold quantised inverse depths, whose two parameters stand in the
header), and plain PNGs of 16 bits. Messages are objects with ROS's fields, whoever parsed them.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.recordings.bare import metres_of
from toftrack.recordings.images import LARGEST_PIXELS, SIGNATURE, decoded_png

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
_WORDS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Encodings that may hold depth, and their type. mono16 is rather infrared: only when asked for."""
_SIZE = struct.Struct("<II")
_HEADER = struct.Struct("<iff")
"""Of compressedDepth: the kind of quantisation, and its two parameters."""


def encoding(message: Any, kind: str) -> str:
    """How the pixels of a message are stored: `16UC1`, `rgb8`, `16UC1; compressedDepth png`."""
    return str(message.encoding if kind == IMAGE else message.format)


def is_depth(words: str) -> bool:
    """An `encoding` is one of depth images."""
    return words.startswith(("16UC1", "32FC1")) and _lossless(words)


def depth_image(message: Any, kind: str, unit_m: float) -> np.ndarray:
    """The depth image of an Image or CompressedImage: (H, W) float32 metres, 0 = no reading, new.

    kind: `IMAGE` or `COMPRESSED`.  unit_m: metres of one step of whole numbers. ToftrackError,
    which begins with "it", where its pixels are of another kind, or damaged.
    """
    words = _pixels(message) if kind == IMAGE else _decompressed(message)
    return metres_of(words, unit_m if words.dtype.kind == "u" else 1.0)


def _pixels(message: Any) -> np.ndarray:
    if message.encoding not in _WORDS:
        raise ToftrackError(f"it is {_colour(message.encoding)}, not 16UC1 or 32FC1 depth")
    kind = np.dtype(_WORDS[message.encoding]).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, np.uint8)
    row = width * kind.itemsize
    if height < 1 or width < 1 or step < row or data.size < (height - 1) * step + row:
        raise ToftrackError(f"it has {data.size} bytes, too few for {width}x{height} pixels")
    # The last row may lack the padding that the others have.
    rows = np.zeros(height * step, np.uint8)
    rows[: min(data.size, rows.size)] = data[: rows.size]
    return rows.reshape(height, step)[:, :row].copy().view(kind)


def _decompressed(message: Any) -> np.ndarray:
    words = str(message.format)
    if not words.startswith(("16UC1", "32FC1", "mono16")):
        raise ToftrackError(f"it is {_colour(words)}, not depth")
    if not _lossless(words):
        raise ToftrackError(
            f"it is compressed as '{words}', of which only PNG and RVL are read; play the bag "
            "and record it again with image_transport's format png, or as raw images"
        )
    data = np.asarray(message.data, np.uint8)
    if "rvl" in words.partition(";")[2]:
        depth = decoded_rvl(data[_HEADER.size :].tobytes())
        return _from_inverse(depth, data.tobytes()) if words.startswith("32FC1") else depth
    start = 0 if data[: len(SIGNATURE)].tobytes() == SIGNATURE else _HEADER.size
    image = decoded_png(data[start:].tobytes())
    if image is None or image.ndim != 2 or image.dtype != np.uint16:
        raise ToftrackError(f"its PNG ('{words}') is damaged, or not of 16 bits and one channel")
    if not words.startswith("32FC1"):
        return image
    if start == 0:
        raise ToftrackError("its 32FC1 depth is quantised, and the header that says how is missing")
    return _from_inverse(image, data[:start].tobytes())


def _from_inverse(image: np.ndarray, header: bytes) -> np.ndarray:
    """The quantised inverse depths of compressed 32FC1 to (H, W) float32 metres."""
    _, a, b = _HEADER.unpack_from(header)
    if not (np.isfinite([a, b]).all() and a > 0):
        raise ToftrackError(f"the parameters of its quantised depth make no sense, {a:g} and {b:g}")
    gap = image.astype(np.float32) - np.float32(b)
    with np.errstate(divide="ignore"):
        return np.where(image > 0, np.float32(a) / gap, np.float32(0))


def decoded_rvl(content: bytes) -> np.ndarray:
    """An image of 16 bits, (H, W), of what RVL packed (Wilson, "Fast Lossless Depth Image
    Compression", ISS 2017), after its width and height. ToftrackError, which begins with "it".

    Nibbles, the highest of each little-endian word of 32 bits first, hold three bits of a number,
    the lowest first, and whether more follow. The numbers are, in turn: how many pixels are 0; how
    many after these are not; and of each of those the difference to the last that was not 0, of
    either sign (0, -1, 1, -2, ...).
    """
    width, height = _SIZE.unpack_from(content) if len(content) >= _SIZE.size else (0, 0)
    pixels = width * height
    words = np.frombuffer(content[_SIZE.size : len(content) // 4 * 4], "<u4")
    damaged = ToftrackError("its RVL is damaged")
    if not 0 < pixels <= LARGEST_PIXELS or not words.size:
        raise damaged
    data = words.byteswap().view(np.uint8)
    nibbles = np.stack((data >> 4, data & 15), 1).ravel().astype(np.int64)
    ends = np.flatnonzero(nibbles < 8)
    starts = np.append(0, ends[:-1] + 1)
    if not ends.size or (ends - starts).max() > 10:
        raise damaged
    places = np.arange(ends[-1] + 1) - np.repeat(starts, ends - starts + 1)
    numbers = np.add.reduceat((nibbles[: ends[-1] + 1] & 7) << 3 * places, starts)
    runs, at, found = [], 0, 0
    while found < pixels and at < len(numbers):
        zeros, others = numbers[at : at + 2].tolist() if at + 1 < len(numbers) else (pixels, 1)
        runs.append((at, zeros, others))
        found, at = found + zeros + others, at + 2 + others
    if found != pixels or at > len(numbers):
        raise damaged
    counts = np.array(runs)
    is_difference = np.ones(at, bool)
    is_difference[counts[:, 0]] = is_difference[counts[:, 0] + 1] = False
    steps = numbers[:at][is_difference]
    image = np.zeros(pixels, np.uint16)
    where = np.repeat(np.tile([False, True], len(runs)), counts[:, 1:].ravel())
    image[where] = np.cumsum((steps >> 1) ^ -(steps & 1)) & 0xFFFF
    return image.reshape(height, width)


def _lossless(words: str) -> bool:
    transport = words.partition(";")[2]
    # The oldest compressedDepth does not name itself: it was PNG only.
    return not transport or "compressedDepth" in transport or "png" in transport


def _colour(words: str) -> str:
    return f"an image of the encoding '{words}'" if words else "an image without an encoding"


CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_BROWN = ("plumb_bob", "rational_polynomial")
"""OpenCV's model by its number of coefficients, whichever of the names is given."""


def camera_of(info: Any, rectified: bool) -> Camera:
    """The camera of depth images, of a CameraInfo of ROS 1 (fields D, K, P) or ROS 2 (d, k, p).

    Distortion models: `plumb_bob` and `rational_polynomial` (OpenCV's 4, 5, 8, 12 or 14
    coefficients), `equidistant` (OpenCV's fisheye), and none at all.  rectified: the images are
    free of distortion already: what they are seen through is P. ToftrackError, which begins with
    "it", where it is not calibrated or of another model.
    """
    # ROS 1 writes these names with a capital letter, ROS 2 with a small one.
    names = {name: name if hasattr(info, name) else name.lower() for name in "KPD"}
    stated = {k: np.asarray(getattr(info, name), np.float64).ravel() for k, name in names.items()}
    K, P, distortion = stated["K"].reshape(3, 3), stated["P"].reshape(3, 4), stated["D"]
    if rectified and P[0, 0] > 0:
        K = P
    elif not (K[0, 0] > 0 and K[1, 1] > 0):
        raise ToftrackError("it is not calibrated (K is zero); give one with camera.file=FILE")
    placed = _window(info, K)
    model = str(info.distortion_model)
    if rectified or not distortion.any() and model != "equidistant":
        return Camera(*placed)
    if model == "equidistant":
        return Camera(*placed, distortion[:4], lens="fisheye")
    if model not in _BROWN:
        raise ToftrackError(
            f"its distortion model '{model}' is none of {', '.join(_BROWN)} and equidistant; "
            "rectify the images (image_proc), or give a calibrated camera with camera.file=FILE"
        )
    return Camera(*placed, distortion)


def _window(info: Any, stated: np.ndarray) -> tuple[np.ndarray, int, int]:
    """K, columns and rows of the image that is sent: a part of the sensor's, and binned."""
    roi, bins = info.roi, np.maximum(1, (int(info.binning_x), int(info.binning_y)))
    size = np.array((roi.width or info.width, roi.height or info.height), np.int64) // bins
    K = np.diag([*stated[[0, 1], [0, 1]] / bins, 1.0])
    # As image_geometry has it, without the half pixel by which a bin's centre lies elsewhere.
    K[:2, 2] = (stated[:2, 2] - (roi.x_offset, roi.y_offset)) / bins
    return K, int(size[0]), int(size[1])
