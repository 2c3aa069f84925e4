"""From a depth image to an Observation: which pixels are the hand (paper, section 2.1)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.compute.compiling import compiled, entry_point
from toftrack.errors import check_number

_NEAREST_M = 0.05
"""No camera sees anything nearer."""
_SPECKS = 8
"""So many times the nearest pixel is looked for, which takes a twentieth of sorting them all."""


@dataclass(frozen=True, eq=False)
class Observation:
    """What the likelihood sees of one frame; on the CPU.

    depth_m: (H, W) Z in metres, 0 = no reading; the whole scene.  k: (3, 3) its intrinsics.
    hand: (H, W) bool, the pixels taken for the hand (and the arm it hangs on).
    occluder: (H, W) bool, surfaces in front of where the hand is expected: they hide it.
    nearest_m: depth of the nearest surface, `inf` when nothing is in range.
    other: (H, W) bool, pixels of another tracked hand, which hides what is behind it.
    thing: (H, W) bool, pixels of a thing in the hand, which say nothing: fingers may be behind.
    """

    depth_m: Tensor
    hand: Tensor
    occluder: Tensor
    k: Tensor
    nearest_m: float
    other: Tensor | None = None
    thing: Tensor | None = None

    @property
    def empty(self) -> bool:
        """True when nothing in the frame can be a hand."""
        return not np.isfinite(self.nearest_m)


@dataclass(frozen=True)
class Expected:
    """The depths of an expected hand's joints, and its middle in the camera frame where known."""

    nearest_m: float
    farthest_m: float
    centre_m: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class NearestSurface:
    """The nearest thing in front of the camera is the hand (paper, section 2.1).

    depth_range_m: what is farther behind the nearest point is dropped (the paper: 0.20).
    min_area_m2: of the surface that the nearest point belongs to, so that noisy and flying pixels
        are no hand; 0 = the single nearest pixel, as the paper.
    max_distance_m: nothing beyond this is a hand.
    occluder_margin_m: what is farther in front of a tracked hand hides it; 0 = none, as the paper.
    reach_m: what lies farther beside the middle of an expected hand is none of it, and hides
        nothing of it; inf = nowhere, as the paper.
    max_pixels: images with more pixels are reduced by a whole factor to at most this many.
    """

    depth_range_m: float
    min_area_m2: float
    max_distance_m: float
    occluder_margin_m: float
    reach_m: float
    max_pixels: int

    def __post_init__(self) -> None:
        for name in ("depth_range_m", "min_area_m2", "occluder_margin_m"):
            check_number(f"segmentation.{name}", getattr(self, name), 0)
        check_number("segmentation.max_distance_m", self.max_distance_m, 0, above=True)
        if self.reach_m != math.inf:
            remedy = ", or .inf"
            check_number("segmentation.reach_m", self.reach_m, 0, above=True, remedy=remedy)
        check_number("segmentation.max_pixels", self.max_pixels, 1, whole=True)

    def __call__(
        self,
        depth_m: np.ndarray,
        k: np.ndarray,
        expected: Expected | None = None,
        other: np.ndarray | None = None,
    ) -> Observation:
        """Segment one image.

        depth_m: (H, W) float32 Z, 0 = no reading.  k: (3, 3).
        expected: where a tracked hand should be. What is nearer than that, and not the hand itself
            come nearer, is an occluder and not the nearest surface.
        other: (H, W) bool of the reduced image, pixels of another hand.
        """
        depth_m, k = reduce_image(depth_m, k, self.max_pixels)
        shape, focal_area = depth_m.shape, float(k[0, 0] * k[1, 1])
        valid, occluder = np.empty(shape, np.bool_), np.zeros(shape, np.bool_)
        around = np.ones(shape, np.uint8)
        nobody, depths, pixel_m2 = np.zeros(shape, np.bool_), (0.0, 0.0), 0.0
        if expected is not None and expected.centre_m is not None and self.reach_m < math.inf:
            around = _disc(shape, k, expected.centre_m, self.reach_m)
        if expected is not None and self.occluder_margin_m > 0:
            margin_m, pixel_m2 = self.occluder_margin_m, expected.nearest_m**2 / focal_area
            depths = expected.nearest_m - margin_m, expected.farthest_m + margin_m
        masks = around, nobody if other is None else other
        limits = tuple(map(np.float32, (self.max_distance_m, *depths)))
        _part(depth_m, *masks, limits, (pixel_m2, float(self.min_area_m2)), valid, occluder)
        nearest = self._nearest(depth_m, valid, focal_area)
        farthest = nearest + self.depth_range_m
        if expected is not None and self.occluder_margin_m > 0:
            # What is well behind a tracked hand is the body, not a part of the hand it misses.
            farthest = min(farthest, expected.farthest_m + 2 * self.occluder_margin_m)
        hand = valid & (depth_m >= nearest) & (depth_m <= farthest)
        return Observation(
            torch.from_numpy(depth_m),
            torch.from_numpy(hand),
            torch.from_numpy(occluder),
            torch.from_numpy(k.astype(np.float32)),
            nearest,
            None if other is None else torch.from_numpy(other),
        )

    def _nearest(self, depth_m: np.ndarray, valid: np.ndarray, focal_area: float) -> float:
        """Depth of the nearest surface that is large enough for a hand; inf where there is none."""
        dropped = np.ones((depth_m.shape[0] + 2, depth_m.shape[1] + 2), np.uint8)
        inside = dropped[1:-1, 1:-1]
        inside[:] = ~valid
        flags = 4 | cv2.FLOODFILL_FIXED_RANGE | cv2.FLOODFILL_MASK_ONLY | (1 << 8)
        for row, column in _nearest_first(depth_m, inside):
            if inside[row, column]:
                continue
            nearest = float(depth_m[row, column])
            if self.min_area_m2 <= 0:
                return nearest
            # What hangs together with it, down to the depth that a hand has, is looked at once and
            # dropped: too small for a hand, it is a speck.
            up_to = float(self.depth_range_m)
            pixels = cv2.floodFill(depth_m, dropped, (column, row), 0, 0, up_to, flags)[0]
            if pixels * nearest**2 / focal_area >= self.min_area_m2:
                return nearest
        return float("inf")


def _disc(
    shape: tuple[int, ...], k: np.ndarray, centre_m: tuple[float, float, float], radius_m: float
) -> np.ndarray:
    """(H, W) uint8: 1 for the pixels within `radius_m` of a point, seen at its distance."""
    x, y, z = centre_m
    z = max(z, _NEAREST_M)  # what is expected of a track may even lie behind the camera
    u, v = k[0, 0] * x / z + k[0, 2], k[1, 1] * y / z + k[1, 2]
    disc = np.zeros(shape, np.uint8)
    limit = 4 * max(shape)
    at = (round(min(max(u, -limit), limit)), round(min(max(v, -limit), limit)))
    cv2.circle(disc, at, min(round(radius_m * k[0, 0] / z), limit), 1, -1)
    return disc


@entry_point
def _part(depth, around, other, limits, areas, valid, occluder):
    """The pixels that may be of a hand, and those that hide it; all (H, W), the last two written.

    around: not 0 where the hand may be.  other: another hand's.  occluder: of False.
    limits: the farthest depth; those from which on, and up to which, an expected hand is.
    areas: m2 of a pixel at its depth, 0 = no hand is expected; and what of it must be seen before
        anything hides it.
    """
    most, front, back = limits
    height, width = depth.shape
    count = 0
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            valid[v, u] = (z > 0) & (z <= most) & (around[v, u] > 0) & (not other[v, u])
            count += valid[v, u] & (z >= front) & (z < back)
    if not count * areas[0] > areas[1]:
        return
    # Pixels on an occluder's edge mix it with what is behind, and are neither.
    for v in range(height):
        for u in range(width):
            if valid[v, u] and depth[v, u] < front:
                for row in range(max(v - 1, 0), min(v + 2, height)):
                    for column in range(max(u - 1, 0), min(u + 2, width)):
                        occluder[row, column] = True
    for v in range(height):
        for u in range(width):
            valid[v, u] &= not occluder[v, u]


def _nearest_first(depth_m: np.ndarray, dropped: np.ndarray) -> Iterator[tuple[int, int]]:
    """Row and column of the nearest pixel that is not dropped, again and again: some are dropped
    meanwhile. When that took long, all others are sorted.

    dropped: (H, W) uint8.
    """
    for _ in range(_SPECKS):
        left = dropped == 0
        if not left.any():
            return
        column, row = cv2.minMaxLoc(depth_m, left.view(np.uint8))[2]
        yield row, column
    rows, columns = np.nonzero(dropped == 0)
    order = np.argsort(depth_m[rows, columns], kind="stable")
    yield from zip(rows[order].tolist(), columns[order].tolist(), strict=True)


def reduce_image(
    depth_m: np.ndarray, k: np.ndarray, max_pixels: int
) -> tuple[np.ndarray, np.ndarray]:
    """Reduce an image by a whole factor; returns the image and its intrinsics.

    Depths stay real ones: the median-filtered pixel in the middle of each block, so that no new
    flying pixels arise.
    """
    factor = int(np.ceil(np.sqrt(depth_m.size / max_pixels)))
    if factor <= 1:
        return np.require(depth_m, np.float32, ("C", "W")), k
    offset, k = (factor - 1) // 2, k.copy()
    depth = np.ascontiguousarray(depth_m, np.float32)
    small = np.empty([len(range(offset, size, factor)) for size in depth.shape], np.float32)
    _median_of_blocks(depth, factor, small)
    k[0] /= factor
    k[1] /= factor
    k[0, 2] -= offset / factor
    k[1, 2] -= offset / factor
    return small, k


@entry_point
def _median_of_blocks(depth, factor, small):
    """The median of 3 x 3 pixels in the middle of each block of factor x factor, whose border
    repeats; a fifth of OpenCV's time, which filters all pixels.
    """
    (height, width), offset = depth.shape, (factor - 1) // 2
    least = np.empty(width, np.float32)
    middle, most = np.empty_like(least), np.empty_like(least)
    for row in range(len(small)):
        v = offset + row * factor
        above, here, below = depth[max(v - 1, 0)], depth[v], depth[min(v + 1, height - 1)]
        for u in range(width):  # as many at once as the processor can
            less, more = min(above[u], here[u]), max(above[u], here[u])
            least[u], most[u] = min(less, below[u]), max(more, below[u])
            middle[u] = max(less, min(more, below[u]))
        for column in range(small.shape[1]):
            u = offset + column * factor
            left, right = max(u - 1, 0), min(u + 1, width - 1)
            low = max(least[left], max(least[u], least[right]))
            high = min(most[left], min(most[u], most[right]))
            small[row, column] = _median(low, _median(middle[left], middle[u], middle[right]), high)


@compiled
def _median(a, b, c):
    """Of three numbers."""
    return max(min(a, b), min(max(a, b), c))
