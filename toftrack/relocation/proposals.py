"""From depth images to hypotheses: where hands may be, and what poses they may have there.

The networks know right hands. For a left one the image is mirrored before, and what was found is
mirrored after: t_x -> -t_x, R -> M R M with M = diag(-1, 1, 1), angles as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from toftrack.compute.rotations import rotmat_to_rotvec
from toftrack.relocation.crops import crop, wide
from toftrack.relocation.network import STRIDE, Finder, PoseNet

_KEPT = 12
"""Hypotheses of a crop that are looked at further."""
_MIRROR = torch.tensor([-1.0, 1.0, 1.0])
_MIRROR_TURN = torch.tensor([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Places:
    """Where hands of one side may be, likeliest first.

    centre_m: (P, 3) middles of palms, camera frame.  probability: (P,).
    """

    centre_m: np.ndarray
    probability: np.ndarray


@dataclass(frozen=True)
class Look:
    """What the pose network says of C crops, in the camera frame.

    pivot_m: (C, H, 3) middle of the palm.  rotvec: (C, H, 3).  angles: (C, H, 21).
    log_size: (C, H) of the hand's length in units of the mean adult's.
    log_probability, error_m: (C, H).  Hypotheses are sorted by probability.
    joints_m: (C, 21, 3) by the cells' votes.  sigma_m: (C, 21).
    present, right: (C,) logits; `right` is of the side that was looked for.
    parts: (C, SEGMENTS, PARTS, PARTS) probabilities, in the crop.
    """

    pivot_m: Tensor
    rotvec: Tensor
    angles: Tensor
    log_size: Tensor
    log_probability: Tensor
    error_m: Tensor
    joints_m: Tensor
    sigma_m: Tensor
    present: Tensor
    right: Tensor
    parts: Tensor


def mirrored(depth_m: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The image as a mirror shows it, and its intrinsics."""
    k = k.copy()
    k[0, 2] = depth_m.shape[1] - 1 - k[0, 2]
    return np.ascontiguousarray(depth_m[:, ::-1]), k


@torch.inference_mode()
def find_hands(
    finder: Finder, depth_m: np.ndarray, k: np.ndarray, most: int, least: float
) -> dict[str, Places]:
    """Where hands of either side may be: at most `most` places each, at least `least` likely.

    depth_m: (H, W) rectified Z in metres, 0 = no reading.  k: (3, 3).
    """
    image, wide_k = wide(depth_m, k)
    found = finder(image)
    heat = found.heat.sigmoid()
    peaks = (heat == F.max_pool2d(heat, 3, 1, 1)) & (heat >= least)
    places = {}
    for channel, side in enumerate(("right", "left")):
        row, column = peaks[0, channel].nonzero().unbind(1)
        at = (0, channel, row, column)
        order = heat[at].argsort(descending=True)[:most]
        row, column = row[order], column[order]
        at = (0, channel, row, column)
        z = found.log_depth[at].exp().clamp(0.1, 3.0).numpy()
        u = (column + found.column[at].clamp(-2, 2) + 0.5).numpy() * STRIDE - 0.5
        v = (row + found.row[at].clamp(-2, 2) + 0.5).numpy() * STRIDE - 0.5
        x, y = (u - wide_k[0, 2]) / wide_k[0, 0] * z, (v - wide_k[1, 2]) / wide_k[1, 1] * z
        places[side] = Places(np.stack((x, y, z), 1).astype(np.float32), heat[at].numpy())
    return places


@torch.inference_mode()
def look(
    pose: PoseNet, depth_m: np.ndarray, k: np.ndarray, centres_m: np.ndarray, side: str
) -> Look:
    """Hypotheses of a hand of one side about each of C centres (C, 3); C is at least 1."""
    centres_m = np.asarray(centres_m, np.float64).reshape(-1, 3)
    if side == "left":
        depth_m, k = mirrored(depth_m, k)
        centres_m = centres_m * _MIRROR.numpy()
    crops, turns = zip(*(crop(depth_m, k, centre) for centre in centres_m), strict=True)
    image = torch.from_numpy(np.stack(crops)).to(memory_format=torch.channels_last)
    p = pose(image)
    turn = torch.from_numpy(np.stack(turns)).float()  # (C, 3, 3)
    centre = torch.from_numpy(centres_m).float()
    order = p.log_probability.argsort(1, descending=True)[:, :_KEPT]

    def ordered(values: Tensor) -> Tensor:
        return values[torch.arange(len(order))[:, None], order]

    pivot = ordered(p.pivot_m) @ turn.mT + centre[:, None]
    rotvec = rotmat_to_rotvec(turn[:, None] @ ordered(p.rotation))
    joints = p.joints_m @ turn.mT + centre[:, None]
    if side == "left":
        pivot, joints, rotvec = pivot * _MIRROR, joints * _MIRROR, rotvec * _MIRROR_TURN
    return Look(
        pivot_m=pivot,
        rotvec=rotvec,
        angles=ordered(p.angles),
        log_size=ordered(p.log_size),
        log_probability=ordered(p.log_probability),
        error_m=ordered(p.error_m),
        joints_m=joints,
        sigma_m=p.sigma_m,
        present=p.present,
        right=p.right,
        parts=p.parts.softmax(1),
    )
