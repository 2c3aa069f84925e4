"""Training crops on a CUDA device: the pictures of pictures.py and the crops of images_numba.py.

The same formulas in float32, a lane to a pixel. Two things differ: rays walk one by one, and the
primitives of a skin join in the order in which they are listed, not by distance, so that creases
may lie a little elsewhere; and the sensors' noise is drawn by the device.
"""

from __future__ import annotations

import torch
import triton
from torch import Tensor

from toftrack.detector.crops import CROP, CROP_CHANNELS, CROP_M
from toftrack.detector.network import PARTS
from toftrack.training import pictures as cpu
from toftrack.training import pictures_kernels as kernels
from toftrack.training.hands import FOREARM, THING
from toftrack.training.pictures import Shots
from toftrack.training.things_numba import BALL, BOX, PART, RING

_TILE = 16
"""Pixels to a side of what one program draws."""
_BLOCK = 256
_FARTHEST_M = 8.0
_MOST_PRIMITIVES = 64
"""Of a skin: a program remembers in the bits of a word which of them it sees."""
_BOX_FIRST, _BOX_LAST = -10, 100_000
_MOST_SHADOW = 10
"""Pixels that a shadow is wide at most, see random_sensors."""


def take(shots: Shots, size: tuple[int, int], seed: int) -> tuple[Tensor, Tensor]:
    """Depths and labels (N, H, W), see pictures.take.

    shots: on the device.  seed: of the sensors' noise, beside those of the shots.
    """
    clean, labels = draw(shots, size)
    n, height, width = clean.shape
    device, lens, sensors = clean.device, shots.lens, shots.sensors
    grid = (triton.cdiv(height * width, _BLOCK), n)
    shape = (height, width)
    clean = _with_hollows(clean, labels, lens, sensors[:, cpu.HOLLOW], grid)
    seeds = (shots.seeds + seed).remainder(2**31 - 1).int()
    noisy = torch.zeros_like(clean)
    kernels.sense_kernel[grid](
        clean, labels, sensors, seeds, lens, noisy, *shape,
        cpu.SENSOR_TERMS, cpu.NOISE, cpu.FLYING, cpu.BIAS, cpu.HOLES, cpu.STEP, cpu.RANGE,
        cpu.BLUR, cpu.DARK, FOREARM, _BLOCK,
    )  # fmt: skip
    depth = torch.zeros_like(clean)
    reaches = sensors[:, cpu.SMOOTH].int()
    kernels.smooth_kernel[grid](
        noisy, depth, reaches, lens, *shape, float(cpu.ONE_SURFACE_M), _BLOCK
    )
    generator = torch.Generator(device).manual_seed(seed)
    patches = torch.rand(n, 4, 3, device=device, generator=generator)
    kernels.finish_kernel[grid](
        depth, clean, sensors, patches, seeds, lens, *shape,
        cpu.SENSOR_TERMS, cpu.COARSE, cpu.SHADOW, cpu.PATCHES, _MOST_SHADOW, _BLOCK,
    )  # fmt: skip
    return depth, labels


def draw(shots: Shots, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Depths (N, H, W), FARTHEST where nothing is, and labels (N, H, W) int8, -1 = not seen."""
    n, e = shots.which.shape
    s, p = shots.whose.shape[1:]
    assert p <= _MOST_PRIMITIVES
    device, (height, width) = shots.which.device, size
    depth = torch.zeros(n, height, width, device=device)
    labels = torch.full((n, height, width), -1, dtype=torch.int8, device=device)
    columns, rows = triton.cdiv(width, _TILE), triton.cdiv(height, _TILE)
    parts = shots.parts
    kernels.draw_kernel[(columns * rows, n)](
        _packed(shots),
        _ellipsoid_boxes(shots),
        shots.which,
        shots.planes,
        shots.primitives,
        _balls(shots),
        shots.whose,
        shots.widths,
        parts,
        _ball_boxes(parts[..., 1:4], parts[..., 18], parts[..., 0] >= 0, shots.lens),
        shots.lens,
        depth,
        labels,
        e,
        shots.planes.shape[1],
        s,
        p,
        parts.shape[1],
        height,
        width,
        _FARTHEST_M,
        THING,
        PART,
        BALL,
        RING,
        BOX,
        _TILE,
    )
    return depth, labels


def read_pictures(
    depth: Tensor, labels: Tensor, side: Tensor, distance_m: Tensor, turn: Tensor, border: Tensor
) -> tuple[Tensor, Tensor]:
    """Crops (N, CROP_CHANNELS, CROP, CROP) and parts (N, PARTS, PARTS) int64, see images_numba."""
    n, *shape = depth.shape
    image = depth.new_empty(n, CROP_CHANNELS, CROP, CROP)
    parts = torch.empty(n, PARTS, PARTS, dtype=torch.int64, device=depth.device)
    kernels.read_kernel[(CROP * CROP // _BLOCK, n)](
        depth, side, distance_m, turn, border, image, *shape,
        2 / CROP_M, CROP, CROP_CHANNELS, _BLOCK,
    )  # fmt: skip
    kernels.parts_kernel[(PARTS * PARTS // _BLOCK, n)](
        labels, side, turn, border, image, parts, *shape, CROP, CROP_CHANNELS, PARTS, _BLOCK
    )
    return image, parts


def _packed(shots: Shots) -> Tensor:
    """(N, E, 13): the inverse of the axes, the centre by it, and |that|^2 - 1."""
    centre = (shots.whiten @ shots.centres[..., None])[..., 0]
    outside = centre.square().sum(-1, keepdim=True) - 1.0
    return torch.cat((shots.whiten.flatten(2), centre, outside), 2).contiguous()


def _ellipsoid_boxes(shots: Shots) -> Tensor:
    """(N, E, 4) int32 first and last column, first and last row; see _as_boxes."""
    x, y, z = shots.centres.unbind(-1)
    square = shots.axes @ shots.axes.mT
    w = 1 / (z * z - square[..., 2, 2])
    boxes = []
    for place, one in ((x, 0), (y, 1)):
        at = (place * z - square[..., one, 2]) * w
        half = (at * at - (place * place - square[..., one, one]) * w).clamp(min=0).sqrt()
        f, middle = shots.lens[:, None, 0], shots.lens[:, None, 1 + one]
        boxes += [((at - half) * f + middle).ceil(), ((at + half) * f + middle).floor()]
    drawn = (shots.which >= 0) & (z - square[..., 2, 2].sqrt() >= 0.05)
    return _as_boxes(torch.stack(boxes, -1), drawn)


def _ball_boxes(place: Tensor, r: Tensor, there: Tensor, lens: Tensor) -> Tensor:
    """The same of balls in front of the camera."""
    z = place[..., 2]
    w = 1 / (z * z - r * r)
    boxes = []
    for one in range(2):
        at = place[..., one] * z * w
        half = (at * at - (place[..., one].square() - r * r) * w).clamp(min=0).sqrt()
        f, middle = lens[:, None, 0], lens[:, None, 1 + one]
        boxes += [((at - half) * f + middle).ceil(), ((at + half) * f + middle).floor()]
    return _as_boxes(torch.stack(boxes, -1), there & (z - r >= 0.05))


def _as_boxes(boxes: Tensor, drawn: Tensor) -> Tensor:
    """Of what is not drawn, the first pixel lies beyond any last one."""
    boxes = boxes.clamp(_BOX_FIRST, _BOX_LAST)
    none = torch.where(drawn, 0.0, float(2 * _BOX_LAST))
    first = torch.stack((none, torch.zeros_like(none), none, torch.zeros_like(none)), -1)
    return (torch.nan_to_num(boxes) + first).int().contiguous()


def _balls(shots: Shots) -> Tensor:
    """(N, S, P, 4) about skins' primitives and their joints; a radius below 0: not drawn."""
    p = shots.primitives
    blend, outside = shots.widths[..., None, 0], shots.widths[..., None, 1]
    cone = p[..., 14] >= 0
    radius = torch.where(cone, torch.maximum(p[..., 12], p[..., 13]) * 1.1, p[..., 12])
    half = torch.where(cone, 0.5 * p[..., 14], 0.0)
    shift = (half / p[..., 6:9].norm(dim=-1))[..., None]
    place = p[..., :3] + shift * p[..., 6:9]
    r = radius + half + outside.clamp(min=0) + 1.5 * blend
    drawn = (shots.whose >= 0) & (place[..., 2] - r >= 0.05)
    return torch.cat((place, torch.where(drawn, r, -1.0)[..., None]), -1).contiguous()


def _with_hollows(
    clean: Tensor, labels: Tensor, lens: Tensor, deeper: Tensor, grid: tuple[int, int]
) -> Tensor:
    """See pictures._deepen; deeper: (N,) by what part of their depth."""
    n, *shape = clean.shape
    nearest = torch.where(labels < 0, _FARTHEST_M, clean).flatten(1).amin(1)
    reach = (0.5 * float(cpu.HOLLOW_M) * lens[:, 0] / (nearest + float(cpu.HOLLOW_DEPTH_M))).int()
    reach = torch.where(deeper > 0, reach, 0).int()
    around, other = clean, torch.empty_like(clean)
    for farthest, down in ((False, False), (False, True), (True, False), (True, True)):
        kernels.extreme_kernel[grid](around, other, reach, lens, *shape, farthest, down, _BLOCK)
        around, other = other, torch.empty_like(clean)
    hollow = clean - around
    deep = (reach > 0)[:, None, None] & (labels >= 0) & (hollow < float(cpu.HOLLOW_DEPTH_M))
    return torch.where(deep, clean + deeper[:, None, None] * hollow, clean)
