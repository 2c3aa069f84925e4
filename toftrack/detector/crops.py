"""What the networks see: a metric crop about a point, and the whole image at one focal length.

Both come from the rectified image as it is, at any resolution, by reading the nearest pixel at the
points of a grid; nothing is interpolated over depth edges.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from torch import Tensor

CROP_M = 0.30
"""Side of the cube that a crop shows."""
CROP = 64
"""Cells of a crop, each of 2 x 2 readings."""
CROP_CHANNELS = 8
"""Of a crop, see `channels`."""
WIDE_F_PX = 100.0
"""Focal length of the whole image that the finder sees, pixels."""
WIDE_MULTIPLE = 16
"""Its columns and rows are a multiple of this."""
WIDE_LARGEST_PX = 512
"""Its most columns and rows: a wider view than 137 degrees is seen at a smaller focal length."""
WIDE_RANGE_M = 1.6
"""Farther away, all is the same to the finder."""


def crop_rotation(centre_m: np.ndarray, up: np.ndarray | None = None) -> np.ndarray:
    """(3, 3) from the crop's frame, whose z axis points at the centre (3,), to the camera's.

    up: (3,) what is up in the crop (-y), as far as it lies across; None: as the camera has it.
    """
    upright = _shortest_rotation(centre_m)
    if up is None:
        return upright
    across, down, _ = up @ upright
    angle = upright_angle(float(across), float(down))
    c, s = math.cos(angle), math.sin(angle)
    return upright @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def upright_angle(across: float, down: float) -> float:
    """By how much a crop is turned about its z axis so that a direction in it, x and y, is up."""
    return math.atan2(across, -down) if across or down else 0.0


def _shortest_rotation(centre_m: np.ndarray) -> np.ndarray:
    x, y, z = map(float, centre_m)
    distance = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    x, y, z = x / distance, y / distance, z / distance
    # The shortest one; straight back there is none.
    part = 1 / max(1 + z, 1e-12)
    return np.array(
        [[1 - x * x * part, -x * y * part, x], [-x * y * part, 1 - y * y * part, y], [-x, -y, z]]
    )


def crop(
    depth_m: np.ndarray, k: np.ndarray, centre_m: np.ndarray, up: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """What is in the cube about a point.

    depth_m: (H, W) rectified Z, 0 = no reading.  k: (3, 3).  centre_m: (3,) in the camera frame.
    up: see crop_rotation.
    Returns (CROP_CHANNELS, CROP, CROP) float32, see `channels`, and the crop's rotation (3, 3).
    """
    rotation = crop_rotation(centre_m, up)
    distance = float(np.linalg.norm(centre_m))
    samples = 2 * CROP
    # The crop's pinhole, mapped into the image: u ~ K R K_crop^-1 u_crop.
    focal = samples * distance / CROP_M
    middle = (samples - 1) / 2
    inverse = np.array(
        [[1 / focal, 0, -middle / focal], [0, 1 / focal, -middle / focal], [0, 0, 1]]
    )
    mapping = np.asarray(k, np.float64) @ rotation @ inverse

    def warped(image: np.ndarray) -> np.ndarray:
        return cv2.warpPerspective(
            image,
            mapping,
            (samples, samples),
            flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        )

    read = warped(depth_m)
    # Z of the camera to z of the crop: along a ray d of the crop, z_crop = Z / (R d)_z.
    steps = (np.arange(samples) - middle) / focal
    slope = rotation[2, 0] * steps[None, :] + rotation[2, 1] * steps[:, None] + rotation[2, 2]
    read = np.where(slope > 0.05, read / np.maximum(slope, 0.05), 0).astype(np.float32)
    inside = (warped(np.ones(depth_m.shape, np.uint8)) > 0) & (slope > 0.05)
    return channels(read[None], inside[None], np.array([distance], np.float32))[0], rotation


def channels(read_m: np.ndarray, inside: np.ndarray, distance_m: np.ndarray) -> np.ndarray:
    """(N, 2 CROP, 2 CROP) readings in crop frames to (N, CROP_CHANNELS, CROP, CROP) float32.

    inside: (N, 2 CROP, 2 CROP) whether a sample lies in the image.
    distance_m: (N,) of the crops' centres.
    The channels: mean depth about the centre in half cubes, -1 .. 1 (1 where nothing is read);
    share of readings in the cube; share without a reading; share outside of the image, so that a
    hand that the border cuts is not taken for a smaller one; the four readings themselves, as the
    first channel, row by row: a finger is only three cells wide.
    """
    n = len(read_m)
    blocks = np.ascontiguousarray(read_m).reshape(n, CROP, 2, CROP, 2)
    valid = blocks > 0
    relative = (blocks - distance_m[:, None, None, None, None]) * np.float32(2 / CROP_M)
    near = valid & (np.abs(relative) < 1)
    count = valid.sum((2, 4), dtype=np.float32)
    total = np.where(valid, relative.clip(-1, 1), 0).sum((2, 4), dtype=np.float32)
    out = np.empty((n, CROP_CHANNELS, CROP, CROP), np.float32)
    out[:, 0] = np.where(count > 0, total / np.maximum(count, 1), 1.0)
    out[:, 1] = near.sum((2, 4), dtype=np.float32) * np.float32(0.25)
    out[:, 2] = 1 - count * np.float32(0.25)
    within = inside.reshape(blocks.shape).sum((2, 4), dtype=np.float32)
    out[:, 3] = 1 - within * np.float32(0.25)
    each = np.where(valid, relative.clip(-1, 1), np.float32(1))
    out[:, 4:] = each.transpose(0, 2, 4, 1, 3).reshape(n, 4, CROP, CROP)
    return out


def wide(depth_m: np.ndarray, k: np.ndarray) -> tuple[Tensor, np.ndarray]:
    """The whole image as the finder sees it, (1, 2, h, w), and its intrinsics (3, 3)."""
    height, width = depth_m.shape
    focal = np.minimum(WIDE_F_PX, k.diagonal()[:2] * WIDE_LARGEST_PX / (width, height))
    scale = focal / k.diagonal()[:2]
    # A multiple, for the network's strides; what is added has no reading.
    w, h = (
        WIDE_MULTIPLE * int(np.ceil(s * f / WIDE_MULTIPLE - 1e-9))
        for s, f in zip((width, height), scale, strict=True)
    )
    u = np.rint((np.arange(w) + 0.5) / scale[0] - 0.5).astype(int)
    v = np.rint((np.arange(h) + 0.5) / scale[1] - 0.5).astype(int)
    read = np.zeros((h, w), np.float32)
    rows, columns = v < height, u < width
    read[np.ix_(rows, columns)] = depth_m[np.ix_(v[rows], u[columns])]
    new_k = np.array(
        [
            [focal[0], 0, (k[0, 2] + 0.5) * scale[0] - 0.5],
            [0, focal[1], (k[1, 2] + 0.5) * scale[1] - 0.5],
            [0, 0, 1],
        ]
    )
    return wide_channels(torch.from_numpy(read)[None]), new_k


def wide_channels(read_m: Tensor) -> Tensor:
    """(N, h, w) readings to (N, 2, h, w): depth in parts of the range, 1 where none; validity."""
    valid = read_m > 0
    far = torch.where(valid, (read_m / WIDE_RANGE_M).clamp(max=1), torch.ones_like(read_m))
    return torch.stack((far, valid.to(read_m.dtype)), 1)
