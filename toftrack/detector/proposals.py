"""From depth images to hypotheses: where hands may be, and what poses they may have there.

The networks know right hands. For a left one the image is read as a mirror shows it, and what was
found is mirrored after: t_x -> -t_x, R -> M R M with M = diag(-1, 1, 1), angles as they are.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.compute.threads import beside, run_shared
from toftrack.compute.transfer import on_device, on_host
from toftrack.detector.crops import CROP, CROP_CHANNELS, crop_at, crop_rotation, wide
from toftrack.detector.decoding_numba import KEPT, decode_at
from toftrack.detector.network import ANGLES, JOINTS, PARTS, STRIDE, Finder, Found, PoseNet
from toftrack.detector.onnx_networks import OnnxFinder, OnnxPoseNet
from toftrack.detector.parts import Parts, likeliest_parts
from toftrack.hand.shape import default_hand_shape

SAME_PLACE_M = 0.06
"""Hands that are detected closer together are one."""
_ONE_PALM_M = 0.035
"""Places of the finder that lie closer together are one palm. It is less than the above, since the
finder takes hands that touch for nearer than they are: 4 cm apart where it was 9."""
_MIRROR = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Places:
    """Where hands may be, likeliest first.

    centre_m: (P, 3) middles of palms, camera frame.  probability: (P,).
    """

    centre_m: np.ndarray
    probability: np.ndarray


@dataclass(frozen=True, eq=False)
class NetworkOutput:
    """What the pose network says of C crops, in the camera frame.

    pivot_m: (C, H, 3) middle of the palm.  rotvec: (C, H, 3).  angles: (C, H, 21).
    log_size: (C, H) of the hand's length in units of the mean adult's.
    log_probability, error_m: (C, H).  Hypotheses are sorted by probability.
    joints_m: (C, H, 21, 3) of mean hands of these sizes.
    keypoints_m: (C, 21, 3) joints by the cells' means.  sigma_m: (C, 21) their deviations.
    present, right: (C,) logits; `right` is of the side that was searched for.
    parts: what it says of the pixels, of each crop.
    """

    pivot_m: Tensor
    rotvec: Tensor
    angles: Tensor
    log_size: Tensor
    log_probability: Tensor
    error_m: Tensor
    joints_m: Tensor
    keypoints_m: Tensor
    sigma_m: Tensor
    present: Tensor
    right: Tensor
    parts: tuple[Parts, ...]


def start_finding(
    finder: Finder | OnnxFinder, depth_m: np.ndarray, k: np.ndarray, most: int, least: float
) -> Callable[[], Places]:
    """Where hands of either side may be: at most `most` places, at least `least` likely.

    depth_m: (H, W) rectified Z in metres, 0 = no reading.  k: (3, 3).
    Begun in another thread if there may be one; what is returned waits for it.
    """

    @torch.inference_mode()
    def look() -> tuple[Found, np.ndarray]:
        image, wide_k = wide(depth_m, k)
        return Found(*on_host(*finder(on_device(image, finder.device)))), wide_k

    wait = beside(look) if isinstance(finder, OnnxFinder) else look
    return lambda: _places(*wait(), most, least)


@torch.inference_mode()
def _places(found: Found, wide_k: np.ndarray, most: int, least: float) -> Places:
    """See start_finding; wide_k: (3, 3) of the image that the finder has seen."""
    # In numpy: on few numbers each of torch's operations takes longer than its arithmetic.
    heat = found.heat[0].sigmoid().numpy()
    peaks = (heat == cv2.dilate(heat, np.ones((3, 3), np.uint8))) & (heat >= least)
    row, column = np.nonzero(peaks)
    order = np.argsort(-heat[row, column], kind="stable")
    row, column = row[order], column[order]
    z, right, down = (
        image[0].numpy()[row, column] for image in (found.log_depth.exp(), found.column, found.row)
    )
    z = z.clip(0.1, 3.0)
    u = (column.astype(np.float32) + right.clip(-2, 2) + 0.5) * STRIDE - 0.5
    v = (row.astype(np.float32) + down.clip(-2, 2) + 0.5) * STRIDE - 0.5
    x, y = (u - wide_k[0, 2]) / wide_k[0, 0] * z, (v - wide_k[1, 2]) / wide_k[1, 1] * z
    centres = np.stack((x, y, z), 1).astype(np.float32)
    rows = _apart(centres, most)
    return Places(centres[rows], heat[row, column][rows])


def _apart(centres_m: np.ndarray, most: int) -> list[int]:
    """Rows of the first of all places that are the same, in their order, `most` at most."""
    kept: list[int] = []
    for row, centre in enumerate(centres_m):
        if len(kept) == most:
            break
        if all(np.linalg.norm(centre - centres_m[other]) > _ONE_PALM_M for other in kept):
            kept.append(row)
    return kept


_SHAPES = {
    "pivot_m": (KEPT, 3),
    "rotvec": (KEPT, 3),
    "angles": (KEPT, ANGLES),
    "log_size": (KEPT,),
    "log_probability": (KEPT,),
    "error_m": (KEPT,),
    "joints_m": (KEPT, JOINTS, 3),
    "keypoints_m": (JOINTS, 3),
    "sigma_m": (JOINTS,),
    "present": (),
    "right": (),
}
"""Of a crop: the numbers of a NetworkOutput, as the compiled code writes them."""


def run_pose_network(
    pose: PoseNet | OnnxPoseNet,
    depth_m: np.ndarray,
    k: np.ndarray,
    centres_m: np.ndarray,
    side: str,
    up: np.ndarray | None = None,
) -> NetworkOutput:
    """Hypotheses of a hand of one side about each of C centres (C, 3); C is at least 1.

    up: (C, 3) where the fingers point, as far as that is known, which is up in the crops, see
    crops.crop_rotation; None: crops as the camera is held. A network that learns hands that are
    upright, more or less, knows them better.
    """
    crops = _Crops(pose, depth_m, k, centres_m, side, up)
    rows = iter(range(len(crops.centres)))
    run_shared(lambda: crops.propose(rows), len(crops.centres) if _may_be_shared(pose) else 1)
    return crops.reported()


def start_pose_network(
    pose: PoseNet | OnnxPoseNet,
    depth_m: np.ndarray,
    k: np.ndarray,
    centre_m: np.ndarray,
    side: str,
    up: np.ndarray | None = None,
) -> Callable[[], NetworkOutput]:
    """The same at one place (3,), `up` (3,), begun in another thread if there may be one; what is
    returned waits for it.

    That thread has nothing to do but the network, so that it hardly needs the interpreter's lock.
    """
    given = pose, depth_m, k, centre_m[None], side, None if up is None else up[None]
    if isinstance(pose, PoseNet) or not _may_be_shared(pose):
        return functools.partial(run_pose_network, *given)
    crops = _Crops(*given)
    image = crops.image(0)
    wait = beside(functools.partial(pose.outputs, image))

    def reported() -> NetworkOutput:
        crops.decode(0, image, wait())
        return crops.reported()

    return reported


def _may_be_shared(pose: PoseNet | OnnxPoseNet) -> bool:
    """Whether other threads may compute: torch has threads of its own, and needs the lock."""
    return isinstance(pose, OnnxPoseNet) and decode_at.is_compiled


class _Crops:
    """Crops, and what is found in them, in arrays of _SHAPES and of the parts' kinds, which are
    written row by row.
    """

    def __init__(
        self,
        pose: PoseNet | OnnxPoseNet,
        depth_m: np.ndarray,
        k: np.ndarray,
        centres_m: np.ndarray,
        side: str,
        up: np.ndarray | None,
    ) -> None:
        self.pose, self.left, self.hand = pose, side == "left", _mean_hand(side)
        self.depth = np.ascontiguousarray(depth_m, np.float32)
        # Copies: numba compiles once more for arrays that must not be written to.
        self.k = np.array(k, np.float64)
        flip = _MIRROR if self.left else 1.0
        self.centres = np.array(centres_m, np.float64).reshape(-1, 3) * flip
        if self.left:  # depth, k and centres are, or are read, as a mirror shows them
            self.k[0, 2] = depth_m.shape[1] - 1 - self.k[0, 2]
        count = len(self.centres)
        ups = [None] * count if up is None else list(np.asarray(up, np.float64) * flip)
        self.rotations = list(map(crop_rotation, self.centres, ups))
        self.numbers = tuple(np.empty((count, *one), np.float32) for one in _SHAPES.values())
        self.kinds = np.empty((count, PARTS, PARTS), np.uint8)

    def propose(self, rows: Iterator[int]) -> None:
        """Of the next crop as long as there is one, which other threads may have taken.

        Each by itself: a batch takes as long, and what is said of a crop would depend on others.
        """
        for row in rows:
            image = self.image(row)
            self.decode(row, image, self.pose.outputs(image))

    def image(self, row: int) -> np.ndarray:
        """(1, CROP_CHANNELS, CROP, CROP)."""
        image = np.empty((1, CROP_CHANNELS, CROP, CROP), np.float32)
        crop_at(self.depth, self.left, self.k, self.centres[row], self.rotations[row], image[0])
        return image

    def decode(self, row: int, image: np.ndarray, outputs: tuple[np.ndarray, ...]) -> None:
        """Write what the network's outputs for a crop mean."""
        heads, keypoints, painted = outputs
        place = self.rotations[row], self.centres[row], self.left
        decode_at(heads[0], keypoints[0], image[0, 0], *place, self.hand, row, self.numbers)
        self.kinds[row] = likeliest_parts(painted[0])

    def reported(self) -> NetworkOutput:
        """All that was written."""
        each = zip(self.kinds, self.rotations, self.centres, strict=True)
        numbers = zip(_SHAPES, map(torch.from_numpy, self.numbers), strict=True)
        return NetworkOutput(**dict(numbers), parts=tuple(Parts(*one, self.left) for one in each))


@functools.cache
def _mean_hand(side: str) -> tuple[np.ndarray, ...]:
    """Frames, places and bones of the mean adult's hand of a side."""
    shape = default_hand_shape(side=side)
    parts = shape.base_frames, shape.base_m, shape.bone_lengths_m
    return tuple(part.double().numpy() for part in parts)
