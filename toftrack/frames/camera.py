"""The camera: intrinsics, lens distortion and depth correction.

Camera frame: x right, y down, z forward, metres. Pixel centres lie at integer (u, v), so that
X = (u - cx) Z / fx and Y = (v - cy) Z / fy on the undistorted image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from toftrack.errors import ToftrackError, check_format, reported_errors
from toftrack.files.json_text import read_json, write_json
from toftrack.frames.help_text import fields_in_help

_FORMAT = "toftrack-camera"
_VERSION = 1
_REMEDY = "give a camera file (.json) that this toftrack wrote"
_COUNTS = (4, 5, 8, 12, 14)
"""How many coefficients OpenCV's lens model may have."""
_LENSES = ("opencv", "fisheye")
_INFINITY = np.uint32(0x7F80_0000)
"""A float32's, read as a whole number."""
# The iteration that undoes a lens: enough for the strong ones, and exact far below a pixel.
_UNTIL = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-9)
_SHORTEST, _LONGEST = 0.1, 50.0
"""Focal lengths as multiples of the image's longer side: from an extreme wide angle to a small part
of a narrow view."""
_TINY_PX = 16
"""Smaller images are parts of others."""
_MOST_OBLONG = 2.5
"""Pixels that were put together in one direction only."""
_MOST_COEFFICIENTS = 32
"""Of a depth polynomial, each of which takes a pass over every image."""
_FARTHEST_ASIDE = 1.5
"""How far the centre may lie beside the image's middle, in longer sides."""


def _numbers(value: object, shape: tuple[int, ...], name: str) -> np.ndarray:
    """`value` as a read-only float64 array of exactly `shape`."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ToftrackError(f"{name} must consist of numbers") from None
    if array.shape != shape:
        expected = "x".join(map(str, shape)) if len(shape) > 1 else f"{shape[0]} numbers"
        raise ToftrackError(f"{name} must be {expected}, but has the shape {array.shape}")
    if not np.isfinite(array).all():
        raise ToftrackError(f"{name} contains NaN or infinity")
    array.setflags(write=False)
    return array


def _check_plausible(K: np.ndarray, width: int, height: int) -> None:
    """ToftrackError for a matrix that no depth camera with images of that size has."""
    (fx, fy), (cx, cy), size = K[[0, 1], [0, 1]], K[:2, 2], max(width, height)
    longest = _LONGEST * max(size, _TINY_PX)
    focal = all(_SHORTEST * size <= f <= longest for f in (fx, fy))
    square = max(fx, fy) <= _MOST_OBLONG * min(fx, fy)
    # Of a part of a larger image the centre may lie outside, but not far beside the view, too.
    aside = abs(np.array([width / 2 - cx, height / 2 - cy]))
    far = (aside > _FARTHEST_ASIDE * size) & (aside > (fx, fy))
    if focal and square and not far.any():
        return
    usual = round(1.1 * size)
    raise ToftrackError(
        f"the camera matrix K cannot be that of images of {width}x{height} pixels (fx, fy {fx:g}, "
        f"{fy:g}, centre {cx:g}, {cy:g}); a plausible one is [[{usual}, 0, {width / 2:g}], "
        f"[0, {usual}, {height / 2:g}], [0, 0, 1]], in pixels"
    )


def largest_reading(depth: np.ndarray) -> float:
    """The largest of float32 readings (H, W); inf where one is negative, infinite or no number.

    In one pass: as whole numbers, these lie above all others, which are ordered as they are.
    """
    bits = depth.view(np.uint32).max()
    return float(bits.view(np.float32)) if bits < _INFINITY else math.inf


# Compared by identity: the fields are arrays, and the tables below are cached per object.
@fields_in_help
@dataclass(frozen=True, eq=False)
class Camera:
    """A camera with one of OpenCV's two lens models and a correction of the measured depth.

    Raises ToftrackError when K is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with finite numbers and
    positive focal lengths, when no camera with images of that size has it, or when a size or
    another coefficient makes no sense.
    """

    K: np.ndarray
    """(3, 3) float64, pixels."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(5))
    """(4,), (5,), (8,), (12,) or (14,) float64: OpenCV's k1 k2 p1 p2, k3, k4 k5 k6, s1 s2 s3 s4,
    tauX tauY; of a `fisheye` (4,), its k1 k2 k3 k4."""
    depth_polynomial: tuple[float, ...] = ()
    """c_0, c_1, ... of the correction: true = measured + sum_i c_i measured^i, radial metres."""
    depth_polynomial_range_m: tuple[float, ...] = ()
    """The nearest and the farthest measured distance that the polynomial was fitted to; beyond them
    the correction stays what it is there, as a polynomial runs wild outside. () = no limits."""
    lens: str = "opencv"
    """Which of OpenCV's models: `opencv` (Brown and Conrady's, its rational form, ...) or `fisheye`
    (Kannala and Brandt's, which ROS calls equidistant)."""

    def __post_init__(self) -> None:
        K = _numbers(self.K, (3, 3), "the camera matrix K")
        if K[0, 1] or K[1, 0] or K[2, 0] or K[2, 1] or K[2, 2] != 1:
            raise ToftrackError(
                "the camera matrix K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without skew"
            )
        for size in (self.width, self.height):
            if not isinstance(size, Real) or not 1 <= size < math.inf or size % 1:
                raise ToftrackError(
                    f"the image size {self.width}x{self.height} must be two whole numbers above 0"
                )
        _check_plausible(K, int(self.width), int(self.height))
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "width", int(self.width))
        object.__setattr__(self, "height", int(self.height))
        if self.lens not in _LENSES:
            raise ToftrackError(f"the lens must be {' or '.join(_LENSES)}, but is {self.lens!r}")
        counts = _COUNTS if self.lens == "opencv" else (4,)
        count = np.size(self.distortion)
        if count not in counts:
            raise ToftrackError(
                f"the lens distortion must be {', '.join(map(str, counts))} numbers (OpenCV's k1 "
                f"k2 p1 p2 k3 ...), but has {count}"
            )
        distortion = _numbers(self.distortion, (count,), "the lens distortion")
        object.__setattr__(self, "distortion", distortion)
        count = np.size(self.depth_polynomial)
        if count > _MOST_COEFFICIENTS:
            raise ToftrackError(
                f"the depth polynomial has {count} coefficients; give at most {_MOST_COEFFICIENTS}"
            )
        polynomial = _numbers(self.depth_polynomial, (count,), "the depth polynomial")
        object.__setattr__(self, "depth_polynomial", tuple(map(float, polynomial)))
        if np.size(self.depth_polynomial_range_m):
            limits = _numbers(self.depth_polynomial_range_m, (2,), "the depth polynomial's range")
            if not 0 <= limits[0] < limits[1]:
                raise ToftrackError("the depth polynomial's range must be nearest, then farthest")
            object.__setattr__(self, "depth_polynomial_range_m", tuple(map(float, limits)))
        else:
            object.__setattr__(self, "depth_polynomial_range_m", ())

    @cached_property
    def _distorted(self) -> bool:
        # A fisheye without coefficients still maps angles, not tangents, to the image.
        return self.lens == "fisheye" or bool(self.distortion.any())

    @cached_property
    def _rays(self) -> np.ndarray:
        v, u = np.mgrid[: self.height, : self.width].astype(np.float64)
        focal, centre = self.K[[0, 1], [0, 1]], self.K[:2, 2]
        pixels = np.stack([u, v], axis=-1)
        lens = pixels.reshape(-1, 1, 2), self.K, self.distortion
        if not self._distorted:
            rays = (pixels - centre) / focal
        elif self.lens == "fisheye":
            rays = cv2.fisheye.undistortPoints(*lens, criteria=_UNTIL)
        else:
            # OpenCV 5 has taken the function of 4 that can be told when to stop into the other one.
            undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
            rays = undistort(*lens, R=None, P=None, criteria=_UNTIL)
        rays = rays.reshape(self.height, self.width, 2)
        rays.setflags(write=False)
        return rays

    @cached_property
    def _ray_lengths(self) -> np.ndarray:
        """(H, W) float32: distance along the pixel's ray over the distance along the axis."""
        return np.sqrt(1.0 + (self._rays**2).sum(axis=-1)).astype(np.float32)

    @cached_property
    def _undistortion_map(self) -> np.ndarray:
        """(H, W, 2) int16: the nearest pixel of the measured image."""
        size = (self.width, self.height)
        fisheye = self.lens == "fisheye"
        make = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
        maps = make(self.K, self.distortion, np.eye(3), self.K, size, cv2.CV_32FC1)
        return cv2.convertMaps(*maps, cv2.CV_16SC2, nninterpolation=True)[0]

    def normalised_rays(self) -> np.ndarray:
        """(H, W, 2) float64: x and y at Z = 1 of each pixel's ray, after undistortion; cached."""
        return self._rays

    def rectify(self, depth: np.ndarray, radial: bool) -> np.ndarray:
        """A measured image to Z on the undistorted pinhole grid, with 0 for no reading.

        In this order: NaN, infinities and negative readings become "no reading"; the depth
        polynomial corrects the radial distance; radial distance becomes Z; the lens distortion is
        undone by the nearest pixel (interpolation would invent surfaces at the hand's edge).

        depth: (H, W) metres, Z or, if `radial`, the distance along the pixel's ray.

        Returns a new (H, W) float32, metres. Raises ToftrackError: it is not of the camera's size.
        """
        self.check_size(depth)
        # A large image takes as long as memory does: nearly all are clean, and as few passes as
        # possible are made over them.
        z = measured = np.ascontiguousarray(depth, np.float32)
        if largest_reading(z) == np.inf:
            z = np.where((z > 0) & (z < np.inf), z, np.float32(0))
        if self.depth_polynomial:
            z = self._corrected(self.to_radial(z, radial))
            z /= self._ray_lengths
        elif radial:
            z = z / self._ray_lengths
        if self._distorted:
            return self._undistort(z)
        return z.copy() if z is measured else z

    def to_radial(self, depth: np.ndarray, radial: bool) -> np.ndarray:
        """A measured image, (H, W) metres, as distances along the pixels' rays."""
        return depth if radial else depth * self._ray_lengths

    def undistort_amplitude(self, amplitude: np.ndarray | None) -> np.ndarray | None:
        """The (H, W) amplitude image on the grid of `rectify`, in its own type; None stays None."""
        if amplitude is None:
            return None
        self.check_size(amplitude)
        return self._undistort(amplitude) if self._distorted else amplitude

    def project(self, points: np.ndarray) -> np.ndarray:
        """(..., 3) points in metres, camera frame, to (..., 2) pixels of the undistorted image.

        Points at Z <= 0 have no image and give NaN.
        """
        points = np.asarray(points, dtype=np.float64)
        z = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        return points[..., :2] / z * self.K[[0, 1], [0, 1]] + self.K[:2, 2]

    def save(self, path: str | Path) -> None:
        """Write the camera as JSON. Raises ToftrackError when the file cannot be written."""
        with reported_errors(f"the camera file '{path}' cannot be written", "choose another place"):
            write_json(path, self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """The content of a camera file, JSON-able."""
        content = {
            "format": _FORMAT,
            "version": _VERSION,
            "width": self.width,
            "height": self.height,
            "K": self.K.tolist(),
            "distortion": self.distortion.tolist(),
            "depth_polynomial": list(self.depth_polynomial),
        }
        if self.depth_polynomial_range_m:
            content["depth_polynomial_range_m"] = list(self.depth_polynomial_range_m)
        if self.lens != "opencv":
            content["lens"] = self.lens
        return content

    @classmethod
    def load(cls, path: str | Path) -> Camera:
        """Read a camera that `save` wrote. Raises ToftrackError for anything else."""
        if not str(path):
            raise ToftrackError("the camera file's name is empty; give the path of one (.json)")
        with reported_errors(
            f"the camera file '{path}' cannot be read",
            _REMEDY,
            *(OSError, ValueError),
        ):
            content = read_json(Path(path).expanduser())
        return cls.from_dict(content, path)

    @classmethod
    def load_for(cls, path: str | Path, width: int, height: int, images: str) -> Camera:
        """`load` a camera file for images of that size, which errors call `images`."""
        camera = cls.load(path)
        if (camera.width, camera.height) != (width, height):
            raise ToftrackError(
                f"the camera file '{path}' is for {camera.width}x{camera.height} pixels, but "
                f"{images} has {width}x{height}; use the camera that made the images"
            )
        return camera

    @classmethod
    def from_dict(cls, content: Any, path: str | Path) -> Camera:
        """The camera of `to_dict`; `path` is what errors name. Raises ToftrackError as `load`."""
        check_format(path, content, _FORMAT, _VERSION, "a camera file", _REMEDY)
        try:
            needed = {name: content[name] for name in ("K", "width", "height")}
            given = {one.name: content[one.name] for one in fields(cls) if one.name in content}
            return cls(**needed | given)
        except KeyError as error:
            raise ToftrackError(
                f"the camera file '{path}' lacks the key {error}; add it or write the file anew"
            ) from None
        except ToftrackError as error:
            raise ToftrackError(f"in the camera file '{path}', {error}") from None
        except (TypeError, ValueError, OverflowError):
            raise ToftrackError(
                f"the camera file '{path}' has numbers that cannot be read"
            ) from None

    def _corrected(self, measured: np.ndarray) -> np.ndarray:
        """Radial distances (H, W) float32 after the depth polynomial, 0 where there are none."""
        at = measured
        if self.depth_polynomial_range_m:
            at = np.clip(measured, *map(np.float32, self.depth_polynomial_range_m))
        *lower, highest = self.depth_polynomial
        corrected = np.full_like(measured, highest)
        for coefficient in reversed(lower):
            corrected *= at
            corrected += np.float32(coefficient)
        corrected += measured
        # A correction that pushes a reading behind the camera leaves no reading.
        np.maximum(corrected, 0, out=corrected)
        np.copyto(corrected, 0, where=measured == 0)
        return corrected

    def _undistort(self, image: np.ndarray) -> np.ndarray:
        return cv2.remap(image, self._undistortion_map, None, cv2.INTER_NEAREST, borderValue=0)

    def check_size(self, image: np.ndarray, what: str = "the image") -> None:
        """Raise ToftrackError where an image has not the camera's rows and columns."""
        if image.shape != (self.height, self.width):
            size = "x".join(map(str, image.shape[::-1]))
            raise ToftrackError(
                f"{what} has {size} pixels, but its camera {self.width}x{self.height} (columns x "
                "rows); give the camera that took the images (camera.file=FILE)"
            )
