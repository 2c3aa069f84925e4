"""Hypotheses of a crop: compiled code, but for the network between; see proposals.run_pose_network.

The same formulas as PoseNet.decode's and those of proposals, which are the reference, without the
microseconds that every operation costs on a few numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from toftrack.compute.threads import beside, run_shared
from toftrack.detector import proposals
from toftrack.detector.crops import CROP, CROP_CHANNELS, crop_rotation
from toftrack.detector.crops_numba import crop_at
from toftrack.detector.decoding_numba import decode_at
from toftrack.detector.network import ANGLES, JOINTS, PARTS, PoseNet
from toftrack.detector.onnx_networks import OnnxPoseNet
from toftrack.detector.parts import Parts, likeliest_parts
from toftrack.detector.proposals import KEPT, MIRROR, NetworkOutput, mean_hand

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
    """See proposals.run_pose_network, which it is where the network is on another device."""
    if isinstance(pose, PoseNet) and pose.device.type != "cpu":
        return proposals.run_pose_network(pose, depth_m, k, centres_m, side, up)
    crops = _crops(pose, depth_m, k, centres_m, side, up)
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
    crops = _crops(*given)
    image = crops.image(0)
    wait = beside(functools.partial(pose.outputs, image))

    def reported() -> NetworkOutput:
        crops.decode(0, image, wait())
        return crops.reported()

    return reported


def _may_be_shared(pose: PoseNet | OnnxPoseNet) -> bool:
    """Whether other threads may compute: torch has threads of its own, and needs the lock."""
    return isinstance(pose, OnnxPoseNet) and decode_at.is_compiled


@dataclass(frozen=True, eq=False)
class _Crops:
    """Crops, and what is found in them.

    left: depth, k and centres are, or are read, as a mirror shows them.
    out: arrays of _SHAPES and the parts' kinds (C, PARTS, PARTS), written row by row.
    """

    pose: PoseNet | OnnxPoseNet
    depth: np.ndarray
    left: bool
    k: np.ndarray
    centres: np.ndarray
    rotations: list[np.ndarray]
    hand: tuple[np.ndarray, ...]
    out: tuple[np.ndarray, ...]

    def propose(self, rows: Iterator[int]) -> None:
        """Of the next crop as long as there is one, which other threads may have taken.

        Each by itself: a batch takes as long, and what is said of a crop would depend on others.
        """
        for row in rows:
            image = self.image(row)
            self.decode(row, image, _outputs(self.pose, image))

    def image(self, row: int) -> np.ndarray:
        """(1, CROP_CHANNELS, CROP, CROP)."""
        image = np.empty((1, CROP_CHANNELS, CROP, CROP), np.float32)
        crop_at(self.depth, self.left, self.k, self.centres[row], self.rotations[row], image[0])
        return image

    def decode(self, row: int, image: np.ndarray, outputs: tuple[np.ndarray, ...]) -> None:
        """Write what the network's outputs for a crop mean."""
        heads, keypoints, painted = outputs
        *numbers, kinds = self.out
        place = self.rotations[row], self.centres[row], self.left
        decode_at(heads[0], keypoints[0], image[0, 0], *place, self.hand, row, tuple(numbers))
        kinds[row] = likeliest_parts(painted[0])

    def reported(self) -> NetworkOutput:
        """All that was written."""
        *out, kinds = self.out
        each = zip(kinds, self.rotations, self.centres, strict=True)
        numbers = zip(_SHAPES, map(torch.from_numpy, out), strict=True)
        return NetworkOutput(**dict(numbers), parts=tuple(Parts(*one, self.left) for one in each))


def _crops(
    pose: PoseNet | OnnxPoseNet,
    depth_m: np.ndarray,
    k: np.ndarray,
    centres_m: np.ndarray,
    side: str,
    up: np.ndarray | None,
) -> _Crops:
    # Copies: numba compiles once more for arrays that must not be written to.
    centres, k = np.array(centres_m, np.float64).reshape(-1, 3), np.array(k, np.float64)
    ups = None if up is None else np.asarray(up, np.float64)
    left = side == "left"
    if left:
        k[0, 2] = depth_m.shape[1] - 1 - k[0, 2]
        centres = centres * MIRROR.numpy()
        ups = None if ups is None else ups * MIRROR.numpy()
    count = len(centres)
    rotations = [crop_rotation(centres[c], None if ups is None else ups[c]) for c in range(count)]
    numbers = [np.empty((count, *shape), np.float32) for shape in _SHAPES.values()]
    out: tuple[np.ndarray, ...] = (*numbers, np.empty((count, PARTS, PARTS), np.uint8))
    depth = np.ascontiguousarray(depth_m, np.float32)
    return _Crops(pose, depth, left, k, centres, rotations, _mean_hand(side), out)


def _outputs(
    pose: PoseNet | OnnxPoseNet, crops: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """See OnnxPoseNet.outputs."""
    if isinstance(pose, OnnxPoseNet):
        return pose.outputs(crops)
    with torch.inference_mode():
        image = torch.from_numpy(crops).to(memory_format=torch.channels_last)
        heads, *maps = pose.features(image)
    keypoints, parts = (one.contiguous().numpy() for one in maps)
    return heads.numpy(), keypoints, parts


@functools.lru_cache
def _mean_hand(side: str) -> tuple[np.ndarray, ...]:
    shape = mean_hand(side)
    parts = shape.base_frames, shape.base_m, shape.bone_lengths_m
    return tuple(part.double().numpy() for part in parts)
