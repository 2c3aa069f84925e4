"""From depth images to hypotheses: where hands may be, and what poses they may have there.

The networks know right hands. For a left one the image is mirrored before, and what was found is
mirrored after: t_x -> -t_x, R -> M R M with M = diag(-1, 1, 1), angles as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from toftrack.compute.rigid import PIVOT_M
from toftrack.compute.rotations import rotmat_to_rotvec
from toftrack.compute.threads import beside
from toftrack.compute.transfer import on_device, on_host
from toftrack.detector.crops import crop, wide
from toftrack.detector.network import STRIDE, Finder, Found, PoseNet, Proposed
from toftrack.detector.onnx_networks import OnnxFinder
from toftrack.detector.parts import Parts
from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import forward_kinematics

SAME_PLACE_M = 0.06
"""Hands that are detected closer together are one."""
_ONE_PALM_M = 0.035
"""Places of the finder that lie closer together are one palm. It is less than the above, since the
finder takes hands that touch for nearer than they are: 4 cm apart where it was 9."""
KEPT = 12
"""Hypotheses of a crop that are used further."""
MIRROR = torch.tensor([-1.0, 1.0, 1.0])
MIRROR_TURN = torch.tensor([1.0, -1.0, -1.0])


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


def mirrored(depth_m: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The image as a mirror shows it, and its intrinsics."""
    k = k.copy()
    k[0, 2] = depth_m.shape[1] - 1 - k[0, 2]
    return np.ascontiguousarray(depth_m[:, ::-1]), k


@torch.inference_mode()
def find_hands(
    finder: Finder | OnnxFinder, depth_m: np.ndarray, k: np.ndarray, most: int, least: float
) -> Places:
    """Where hands of either side may be: at most `most` places, at least `least` likely.

    depth_m: (H, W) rectified Z in metres, 0 = no reading.  k: (3, 3).
    """
    image, wide_k = wide(depth_m, k)
    found = Found(*on_host(*finder(on_device(image, finder.device))))
    return _places(found, wide_k, most, least)


def start_finding(
    finder: Finder | OnnxFinder, depth_m: np.ndarray, k: np.ndarray, most: int, least: float
) -> Callable[[], Places]:
    """The same, begun in another thread if there may be one; what is returned waits for it."""
    if not isinstance(finder, OnnxFinder):
        return partial(find_hands, finder, depth_m, k, most, least)

    def look() -> tuple[Found, np.ndarray]:
        image, wide_k = wide(depth_m, k)
        return finder(image), wide_k

    wait = beside(look)
    return lambda: _places(*wait(), most, least)


@torch.inference_mode()
def _places(found: Found, wide_k: np.ndarray, most: int, least: float) -> Places:
    """See find_hands; wide_k: (3, 3) of the image that the finder has seen."""
    heat = found.heat.sigmoid()
    peaks = (heat == F.max_pool2d(heat, 3, 1, 1)) & (heat >= least)
    row, column = peaks[0].nonzero().unbind(1)
    order = heat[0, row, column].argsort(descending=True)
    row, column = row[order], column[order]
    at = (0, row, column)
    z = found.log_depth[at].exp().clamp(0.1, 3.0).numpy()
    u = (column + found.column[at].clamp(-2, 2) + 0.5).numpy() * STRIDE - 0.5
    v = (row + found.row[at].clamp(-2, 2) + 0.5).numpy() * STRIDE - 0.5
    x, y = (u - wide_k[0, 2]) / wide_k[0, 0] * z, (v - wide_k[1, 2]) / wide_k[1, 1] * z
    centres = np.stack((x, y, z), 1).astype(np.float32)
    rows = _apart(centres, most)
    return Places(centres[rows], heat[at].numpy()[rows])


def _apart(centres_m: np.ndarray, most: int) -> list[int]:
    """Rows of the first of all places that are the same, in their order, `most` at most."""
    kept: list[int] = []
    for row, centre in enumerate(centres_m):
        if len(kept) == most:
            break
        if all(np.linalg.norm(centre - centres_m[other]) > _ONE_PALM_M for other in kept):
            kept.append(row)
    return kept


@torch.inference_mode()
def run_pose_network(
    pose: PoseNet,
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
    centres_m = np.asarray(centres_m, np.float64).reshape(-1, 3)
    ups = [None] * len(centres_m) if up is None else list(np.asarray(up, np.float64))
    if side == "left":
        depth_m, k = mirrored(depth_m, k)
        centres_m = centres_m * MIRROR.numpy()
        ups = [None if one is None else one * MIRROR.numpy() for one in ups]
    crops, crop_rotations = zip(
        *(crop(depth_m, k, *at) for at in zip(centres_m, ups, strict=True)), strict=True
    )
    image = torch.from_numpy(np.stack(crops))
    image = image.to(memory_format=torch.channels_last)
    p = Proposed(*on_host(*pose(on_device(image, pose.device))))
    turn = torch.from_numpy(np.stack(crop_rotations)).float()  # (C, 3, 3)
    centre = torch.from_numpy(centres_m).float()
    order = p.log_probability.argsort(1, descending=True)[:, :KEPT]

    def ordered(values: Tensor) -> Tensor:
        return values[torch.arange(len(order))[:, None], order]

    pivot = ordered(p.pivot_m) @ turn.mT + centre[:, None]
    rotvec = rotmat_to_rotvec(turn[:, None] @ ordered(p.rotation))
    keypoints = p.joints_m @ turn.mT + centre[:, None]
    if side == "left":
        pivot, keypoints, rotvec = pivot * MIRROR, keypoints * MIRROR, rotvec * MIRROR_TURN
    angles, log_size = ordered(p.angles), ordered(p.log_size)
    return NetworkOutput(
        pivot_m=pivot,
        rotvec=rotvec,
        angles=angles,
        log_size=log_size,
        log_probability=ordered(p.log_probability),
        error_m=ordered(p.error_m),
        joints_m=_joints(pivot, rotvec, angles, log_size, side),
        keypoints_m=keypoints,
        sigma_m=p.sigma_m,
        present=p.present,
        right=p.right,
        parts=tuple(
            Parts(kind, rotation, centre_m, side == "left")
            for kind, rotation, centre_m in zip(
                p.parts.argmax(1).byte().numpy(), crop_rotations, centres_m, strict=True
            )
        ),
    )


def _joints(pivot_m: Tensor, rotvec: Tensor, angles: Tensor, log_size: Tensor, side: str) -> Tensor:
    """(C, H, 21, 3) of mean hands scaled about the middle of the palm."""
    flat = rotvec.flatten(0, 1), angles.flatten(0, 1)
    states = torch.cat((torch.zeros_like(flat[0]), *flat), 1)
    pose = forward_kinematics(states, mean_hand(side))
    # A mirror changes nothing on the palm's middle line.
    middle = pose.frames[:, 0] @ rotvec.new_tensor(PIVOT_M)
    joints = (pose.joints_m - middle[:, None]).unflatten(0, log_size.shape)
    return pivot_m[:, :, None] + joints * log_size.exp()[..., None, None]


@lru_cache
def mean_hand(side: str) -> HandShape:
    """The mean adult's of a side."""
    return default_hand_shape(side=side)
