"""Hypotheses of a crop: compiled code, but for the network between; see proposals.run_pose_network.

The same formulas as PoseNet.decode's and those of proposals, which are the reference, without the
microseconds that every operation costs on a few numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence

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
    task = _prepared(pose, depth_m, k, centres_m, side, up)
    run_shared(task, len(centres_m) if _may_be_shared(pose) else 1)
    return _reported(task)


def start_pose_network(
    pose: PoseNet | OnnxPoseNet,
    depth_m: np.ndarray,
    k: np.ndarray,
    centres_m: np.ndarray,
    side: str,
    up: np.ndarray | None = None,
) -> Callable[[], NetworkOutput]:
    """The same, begun in another thread if there may be one; what is returned waits for it.

    That thread has nothing to do but the network, so that it hardly needs the interpreter's lock.
    """
    if isinstance(pose, PoseNet) or not _may_be_shared(pose):
        return functools.partial(run_pose_network, pose, depth_m, k, centres_m, side, up)
    task = _prepared(pose, depth_m, k, centres_m, side, up)
    _, depth, left, k, centres, rotations, hand, out, rows = task.args
    places = list(zip(rows, rotations, centres, strict=False))
    images = [_crop(depth, left, k, centre, turn) for _, turn, centre in places]
    wait = beside(lambda: [pose.outputs(image) for image in images])

    def reported() -> NetworkOutput:
        for (row, turn, centre), image, outputs in zip(places, images, wait(), strict=True):
            _decode(outputs, image, turn, centre, left, hand, out, row)
        return _reported(task)

    return reported


def _may_be_shared(pose: PoseNet | OnnxPoseNet) -> bool:
    """Whether other threads may compute: torch has threads of its own, and needs the lock."""
    return isinstance(pose, OnnxPoseNet) and decode_at.is_compiled


def _reported(task: functools.partial[None]) -> NetworkOutput:
    """What a task of _prepared has written."""
    _, _, left, _, centres, rotations, _, (*out, kinds), _ = task.args
    parts = tuple(Parts(*one, left) for one in zip(kinds, rotations, centres, strict=True))
    numbers = zip(_SHAPES, map(torch.from_numpy, out), strict=True)
    return NetworkOutput(**dict(numbers), parts=parts)


def _prepared(
    pose: PoseNet | OnnxPoseNet,
    depth_m: np.ndarray,
    k: np.ndarray,
    centres_m: np.ndarray,
    side: str,
    up: np.ndarray | None = None,
) -> functools.partial[None]:
    """What does it, for threads that share the crops."""
    # Copies: numba compiles once more for arrays that must not be written to.
    centres, k = np.array(centres_m, np.float64).reshape(-1, 3), np.array(k, np.float64)
    left = side == "left"
    if left:
        k[0, 2] = depth_m.shape[1] - 1 - k[0, 2]
        centres = centres * MIRROR.numpy()
    ups = [None] * len(centres) if up is None else list(np.asarray(up, np.float64))
    if left:
        ups = [None if one is None else one * MIRROR.numpy() for one in ups]
    rotations = [crop_rotation(*at) for at in zip(centres, ups, strict=True)]
    return functools.partial(
        _propose,
        pose,
        np.ascontiguousarray(depth_m, np.float32),
        left,
        k,
        centres,
        rotations,
        _mean_hand(side),
        _empty(len(centres)),
        iter(range(len(centres))),
    )


def _propose(
    pose: PoseNet | OnnxPoseNet,
    depth: np.ndarray,
    left: bool,
    k: np.ndarray,
    centres: np.ndarray,
    rotations: Sequence[np.ndarray],
    hand: tuple[np.ndarray, ...],
    out: tuple[np.ndarray, ...],
    rows: Iterator[int],
) -> None:
    """Of the next crop as long as there is one, which other threads may have taken.

    Each by itself: a batch takes as long, and what is said of a crop would depend on the others.
    """
    for row in rows:
        image = _crop(depth, left, k, centres[row], rotations[row])
        _decode(_outputs(pose, image), image, rotations[row], centres[row], left, hand, out, row)


def _crop(
    depth: np.ndarray,
    left: bool,
    k: np.ndarray,
    centre: np.ndarray,
    turn: np.ndarray,
) -> np.ndarray:
    """A crop's image (1, CROP_CHANNELS, CROP, CROP)."""
    image = np.empty((1, CROP_CHANNELS, CROP, CROP), np.float32)
    crop_at(depth, left, k, centre, turn, image[0])
    return image


def _decode(
    outputs: tuple[np.ndarray, np.ndarray, np.ndarray],
    image: np.ndarray,
    turn: np.ndarray,
    centre: np.ndarray,
    left: bool,
    hand: tuple[np.ndarray, ...],
    out: tuple[np.ndarray, ...],
    row: int,
) -> None:
    """Into a row of the arrays that are written."""
    heads, keypoints, painted = outputs
    *numbers, kinds = out
    given = heads[0], keypoints[0], image[0, 0], turn, centre, left, hand, row, tuple(numbers)
    decode_at(*given)
    kinds[row] = likeliest_parts(painted[0])


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


def _empty(count: int) -> tuple[np.ndarray, ...]:
    """The arrays of _SHAPES, and the parts' kinds (count, PARTS, PARTS)."""
    numbers = (np.empty((count, *shape), np.float32) for shape in _SHAPES.values())
    return *numbers, np.empty((count, PARTS, PARTS), np.uint8)
