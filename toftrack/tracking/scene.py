"""The scene of a frame before detection: the predicted hands, and which one owns which pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from toftrack.compute.compiling import entry_point
from toftrack.detector.crops import CROP_M, thinned
from toftrack.detector.detection import Detection
from toftrack.detector.flying_pixels import without_flying_pixels
from toftrack.detector.parts import FOREARM_PART
from toftrack.frames.frame import DepthImage
from toftrack.render.model_image import range_image
from toftrack.render.segmentation import Expected, Observation, reduce_image
from toftrack.tracking.filter import PredictedHand, predict
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.state import Track

_TOLERANCE_M, _EDGE_M = np.float32(0.02), np.float32(0.06)
"""A pixel is a hand's if its depth differs by less than the former from the predicted surface's.
Pixels beside the outline, which mix that with what is behind, may be farther by the latter."""
_FAR_M = 5.0
"""Depth of removed pixels: the detector sees nothing so far away."""
_IN_FRONT_M = 0.03
"""What is nearer to the camera than a hand's wrist by more than this may hide the hand."""


Arm = tuple[np.ndarray, np.ndarray]
"""A wrist (3,), and the direction (3,) of the forearm from there, of length 1."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A frame's image, dt_s after the last frame, and the hands predicted in it.

    camera_image: in the resolution of the camera, which what is reported is of.
    """

    tracks: Sequence[Track]
    camera_image: DepthImage
    dt_s: float
    model: TrackerModel

    @cached_property
    def image(self) -> DepthImage:
        """The image that the networks see and hands are segmented in: thinned, without flying
        pixels.
        """
        depth_m, k = thinned(self.camera_image.depth_m, self.camera_image.k)
        depth_m = without_flying_pixels(depth_m, k, self.model.detector.settings.flying)
        return replace(self.camera_image, depth_m=depth_m, k=k)

    @cached_property
    def hands(self) -> tuple[PredictedHand, ...]:
        """The predicted hand of each track; a `row` is an index into them."""
        return tuple(predict(track, self.dt_s, self.model) for track in self.tracks)

    @cached_property
    def reduced(self) -> DepthImage:
        """The image reduced to the (h, w) pixels that hands are segmented in.

        It is made when first asked for: a large image is reduced while the networks look.
        """
        most = self.model.segmentation.max_pixels
        depth_m, k = reduce_image(self.image.depth_m, self.image.k, most)
        return replace(self.image, depth_m=depth_m, k=k)

    @cached_property
    def owners(self) -> np.ndarray:
        """(h, w) int8, the row of the hand that owns each pixel of `reduced`; -1 = none does.

        It is the hand whose surface is nearest to the pixel's depth, or whose outline the pixel
        mixes with what is behind. A track that is not reliable owns no pixels.
        """
        depth_m, k = self.reduced.depth_m, self.reduced.k
        size = depth_m.shape
        drawn = [
            range_image(hand.fitted.refiner.surface(hand.pose), k, *size) for hand in self.hands
        ]
        surfaces = np.array(drawn, np.float32).reshape(-1, *size)  # Z, 0 = none
        reliable = np.array([hand.track.reliable for hand in self.hands], np.bool_)
        owner = np.full(size, -1, np.int8)
        _own(depth_m, surfaces, reliable, np.empty_like(owner), owner)
        return owner

    def owned_by_others(self, row: int) -> np.ndarray | None:
        """(h, w) bool, the pixels that other hands own; None where no other one is reliable."""
        others = (hand.track.reliable for at, hand in enumerate(self.hands) if at != row)
        return (self.owners >= 0) & (self.owners != row) if any(others) else None

    def image_for(self, row: int) -> DepthImage:
        """The image that the pose network sees of the hand of a row, -1 = of a new one.

        It is without the pixels of other hands, or keypoints would lie on their fingers. Those in
        front of the hand stay, as the network knows what hides a hand; but none for a new one.
        """
        if row < 0:
            return self.unexplained
        others = self.owned_by_others(row)
        if others is None:
            return self.image
        nearest = float(self.hands[row].pose[0, 2]) - _IN_FRONT_M
        return self._without(others & (self.reduced.depth_m > nearest))

    @cached_property
    def unexplained(self) -> DepthImage:
        """The image without the pixels that hands own."""
        return self._without(self.owners >= 0) if self.hands else self.image

    def _without(self, pixels: np.ndarray) -> DepthImage:
        depth_m = np.empty_like(self.image.depth_m)
        _remove(self.image.depth_m, pixels, np.float32(_FAR_M), depth_m)
        return replace(self.image, depth_m=depth_m)

    def arm(self, detection: Detection) -> Arm:
        """The arm of a detected hand: towards what the pose network calls a forearm, else away from
        the fingers.
        """
        wrist = detection.keypoints.points_m[0].numpy()
        depth_m, k, reach_m = self.reduced.depth_m, self.reduced.k, CROP_M / 2
        kind = detection.parts.seen(depth_m, np.abs(depth_m - wrist[2]) < reach_m, k)
        row, column = np.nonzero(kind == FOREARM_PART)
        forearm = _points_at(row, column, depth_m, k)
        forearm = forearm[np.abs(forearm - wrist).max(1) < reach_m]  # along each axis
        along = forearm.mean(0) - wrist if len(forearm) else -detection.up
        return wrist, along / max(float(np.linalg.norm(along)), 1e-6)

    def segment(self, expected: Expected, row: int) -> Observation:
        """The observation of the hand of a row, -1 = of a new one, where it is expected."""
        others = self.owned_by_others(row)
        return self.model.segmentation(self.reduced.depth_m, self.reduced.k, expected, others)

    def others_joints(self, row: int) -> tuple[torch.Tensor, ...]:
        """The joints (21, 3) m of each reliable hand but the row's."""
        return tuple(
            hand.joints_m for at, hand in enumerate(self.hands) if at != row and hand.track.reliable
        )


def _points_at(
    row: np.ndarray, column: np.ndarray, depth_m: np.ndarray, k: np.ndarray
) -> np.ndarray:
    """(P, 3) m, the points that an image (H, W) shows at pixels (P,), camera frame."""
    z = depth_m[row, column]
    x, y = (column - k[0, 2]) / k[0, 0] * z, (row - k[1, 2]) / k[1, 1] * z
    return np.stack((x, y, z), 1)


@entry_point
def _remove(depth, pixels, far, left):
    """Copy an image (H, W) into `left`, with the depth `far` at `pixels` (h, w) of the reduced
    image.
    """
    height, width = depth.shape
    down, across = pixels.shape[0] / height, pixels.shape[1] / width
    for v in range(height):
        row = int((v + 0.5) * down)
        for u in range(width):
            left[v, u] = far if pixels[row, int((u + 0.5) * across)] else depth[v, u]


@entry_point
def _own(depth, surfaces, reliable, nearest, owner):
    """See Scene.owners; surfaces: (B, H, W), reliable: (B,) bool.

    nearest: (H, W) int8, written: the row of the surface that a pixel is of, -1 = of none.
    owner: (H, W) int8 of -1.
    """
    height, width = depth.shape
    left, right, top, bottom = width, -1, height, -1
    for v in range(height):
        for u in range(width):
            nearest[v, u], least = -1, _TOLERANCE_M
            for row in range(len(surfaces)):
                if surfaces[row, v, u] > 0 and depth[v, u] > 0:
                    away = abs(surfaces[row, v, u] - depth[v, u])
                    if away < least:
                        nearest[v, u], least = row, away
            if nearest[v, u] >= 0:
                left, right, top, bottom = min(left, u), max(right, u), min(top, v), v
    around = np.empty(len(surfaces), np.float32)
    for v in range(max(top - 1, 0), min(bottom + 2, height)):
        for u in range(max(left - 1, 0), min(right + 2, width)):
            if nearest[v, u] >= 0:
                owner[v, u] = nearest[v, u] if reliable[nearest[v, u]] else -1
            if nearest[v, u] >= 0 or depth[v, u] <= 0:
                continue
            for row in range(len(surfaces)):
                around[row] = 0
            for y in range(max(v - 1, 0), min(v + 2, height)):
                for x in range(max(u - 1, 0), min(u + 2, width)):
                    row = nearest[y, x]
                    if row >= 0:
                        around[row] = max(around[row], surfaces[row, y, x])
            for row in range(len(surfaces)):
                mixed = around[row] > 0 and around[row] < depth[v, u] < around[row] + _EDGE_M
                if mixed and reliable[row]:
                    owner[v, u] = row
