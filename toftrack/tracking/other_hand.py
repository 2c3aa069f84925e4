"""The other hand of two: where it is, and which pixels are its own."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.compute.rigid import pivot_offset
from toftrack.frames import DepthImage

_TOLERANCE_M = 0.02
"""A pixel that is so near to a hand's surface may be the hand's."""
_EDGE_M = 0.06
"""Pixels on the outline of a hand mix it with what is behind, up to this."""
_FAR_M = 5.0
"""So far away is nothing for the networks."""
_TOUCH_M = 0.018
"""Joints of two hands come no nearer to each other, as a rule: fingers are so thick."""


@dataclass(frozen=True, eq=False)
class OtherHand:
    """What a hand's step knows of the other one.

    joints_m: (21, 3).  centre_m: (3,) middle of its palm.
    believed: it is a hand, and not just a place that may be one.
    pixels: (H, W) bool of the reduced image, those that it explains better; None where its last
        estimate was not believed.
    beside: (H, W) bool, those of them that cannot hide this hand; None where the networks need not
        be spared them.
    """

    joints_m: Tensor
    centre_m: np.ndarray
    believed: bool
    pixels: np.ndarray | None = None
    beside: np.ndarray | None = None


def palm_centre_m(state: Tensor) -> np.ndarray:
    """(3,) middle of the palm of a hand (1, 27)."""
    hand = state.numpy()
    centre: np.ndarray = hand[0, :3] + pivot_offset(hand[:, 3:6])[0]
    return centre


def explained(depth_m: np.ndarray, theirs_m: np.ndarray, mine_m: np.ndarray | None) -> np.ndarray:
    """(H, W) bool: pixels of an image that the other hand's surface explains, and better than mine.

    depth_m, theirs_m, mine_m: (H, W) Z, 0 = none.
    """
    there = (depth_m > 0) & (theirs_m > 0)
    off = np.where(there, np.abs(depth_m - theirs_m), np.inf)
    if mine_m is not None:
        there &= off < np.where(mine_m > 0, np.abs(depth_m - mine_m), np.inf)
    sure = there & (off < _TOLERANCE_M)
    # About them lie the mixed pixels of its outline, which are neither hand's.
    near = cv2.dilate(sure.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    around = cv2.dilate(np.where(sure, theirs_m, np.float32(0)), np.ones((3, 3), np.float32))
    mixed = near & ~sure & (depth_m > around) & (depth_m < around + _EDGE_M)
    if mine_m is not None:
        mixed &= ~((mine_m > 0) & (np.abs(depth_m - mine_m) < _TOLERANCE_M))
    return sure | mixed


def touching(joints_m: Tensor, other: OtherHand) -> Tensor:
    """(N,) how much of hands (N, 21, 3) lies in the other one, 0 .. 1."""
    near = torch.cdist(joints_m, other.joints_m.to(joints_m)[None].expand(len(joints_m), -1, -1))
    return (1 - near.amin(2) / _TOUCH_M).clamp(min=0).mean(1)


def without(image: DepthImage, other: OtherHand | None) -> DepthImage:
    """The image as the networks are to see it: with nothing where the other hand is, or they vote
    for its fingers as well. What may hide a hand stays, for they know things that hide hands.
    """
    if other is None or other.beside is None:
        return image
    height, width = image.depth_m.shape
    gone = cv2.resize(other.beside.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return replace(image, depth_m=np.where(gone > 0, np.float32(_FAR_M), image.depth_m))
