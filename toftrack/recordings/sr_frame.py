"""A raw frame of the SwissRanger SR3000: two images of 16-bit words, as USB and `.srs` carry them.

Sources: the vendor's public files give the sizes, the order of the images and the scale of the
distance word. That the words are little-endian is an assumption (the vendor's hosts are).
"""

from __future__ import annotations

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera

WIDTH, HEIGHT = 176, 144
IMAGE_BYTES = WIDTH * HEIGHT * 2
FRAME_BYTES = 2 * IMAGE_BYTES
"""Distance, then amplitude."""
REGISTERS = 64
"""One byte each; what they mean is not public."""

MODULATION_CODES = {40: 0, 30: 1, 21: 2, 20: 3, 19: 4}
"""Modulation frequency in MHz to the vendor's code."""
DEFAULT_MODULATION_MHZ = 20

_LIGHT_M_S = 299_792_458.0
_LARGEST_WORD = 0xFFFF
_WORD = np.dtype("<u2")


def unambiguous_range_m(modulation_mhz: int) -> float:
    """c / 2f, metres: what the largest distance word stands for; ToftrackError for a frequency that
    the camera does not have.
    """
    if modulation_mhz not in MODULATION_CODES:
        raise ToftrackError(
            f"the modulation frequency {modulation_mhz} MHz is not one of the SR3000's "
            f"({', '.join(map(str, MODULATION_CODES))} MHz); set device.modulation_mhz to one of "
            "them (toftrack convert: --modulation)"
        )
    return _LIGHT_M_S / (2e6 * modulation_mhz)


def nominal_camera() -> Camera:
    """The vendor's default: 8 mm lens, 40 um pixels, optical centre (92, 60), no distortion."""
    return Camera(np.array([[200.0, 0, 92], [0, 200.0, 60], [0, 0, 1]]), WIDTH, HEIGHT)


def decode_frame(
    data: bytes, range_m: float, amplitude_threshold: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """The images of a raw frame, new arrays: (144, 176) float32 metres along each pixel's ray, 0 =
    no reading, as of pixels whose amplitude is below the threshold, and the (144, 176) uint16
    amplitude.  range_m: what the largest distance word stands for.
    """
    words = np.frombuffer(data, _WORD).reshape(2, HEIGHT, WIDTH)
    radial = words[0].astype(np.float32) * np.float32(range_m / _LARGEST_WORD)
    amplitude = words[1].astype(np.uint16)
    if amplitude_threshold > 0:
        radial[amplitude < amplitude_threshold] = 0
    return radial, amplitude


def encode_frame(radial_m: np.ndarray, amplitude: np.ndarray | None, range_m: float) -> bytes:
    """The raw frame of two images as `decode_frame` gives them back, distances to range_m / 131070.
    What is no number or beyond the range becomes "no reading"; no amplitude gives zeros.
    ToftrackError where an image is not of the camera's size.
    """
    for image in (radial_m, amplitude):
        if image is not None and image.shape != (HEIGHT, WIDTH):
            raise ToftrackError(
                f"the SR3000 has images of {WIDTH}x{HEIGHT} pixels, but this one has "
                f"{'x'.join(map(str, image.shape[::-1]))}; only such recordings fit its format"
            )
    valid = (radial_m > 0) & (radial_m <= range_m)
    scaled = np.where(valid, radial_m, 0).astype(np.float64) * (_LARGEST_WORD / range_m)
    distance = np.rint(scaled).astype(_WORD)
    if amplitude is None:
        return distance.tobytes() + bytes(IMAGE_BYTES)
    return distance.tobytes() + amplitude.astype(_WORD).tobytes()
