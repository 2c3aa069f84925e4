"""The scoring back end in plain torch: runs on the CPU or CUDA, without anything to compile.

The surface is the ellipsoid in (column, row, inverse depth) of numba/hand.py; here it is evaluated
over the screen box of each ellipsoid (all particles at once, a loop over ellipsoids).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import Ellipsoids, hand_surface
from toftrack.render.scoring import NEAREST_M, Counts, Evidence, compare, dilate_disc

_CHUNK_PIXELS = {"cpu": 1 << 20, "cuda": 1 << 27}
"""Pixels of a chunk of particles: small enough for the cache, large enough for a GPU."""


class Outlines(NamedTuple):
    """Ellipsoids in (column, row, inverse depth), each field (N, E), in pixels and 1/m.

    x, y, u: the centre.  high, wide: half sizes of the box, high is -1 where nothing is drawn.
    shear: columns the middle of a row moves per row.  dx: squared half width of the middle row.
    slope_y, slope_x: of the middle surface.  du: squared half depth over the centre.
    """

    x: Tensor
    y: Tensor
    u: Tensor
    high: Tensor
    wide: Tensor
    shear: Tensor
    dx: Tensor
    slope_y: Tensor
    slope_x: Tensor
    du: Tensor


def outlines(ellipsoids: Ellipsoids, k: Tensor) -> Outlines:
    """Ellipsoids in the camera frame, (N, E), as a camera of (3, 3) intrinsics k sees them."""
    cx, cy, cz = ellipsoids.centres_m.unbind(-1)
    fx, fy = k[0, 0], k[1, 1]
    s = ellipsoids.axes_m @ ellipsoids.axes_m.mT
    xx, xy, xz = s[..., 0, 0], s[..., 0, 1], s[..., 0, 2]
    yy, yz, zz = s[..., 1, 1], s[..., 1, 2], s[..., 2, 2]
    visible = cz - zz.sqrt() > NEAREST_M
    z2 = cz.square()
    w = 1 / (z2 - zz)
    w2 = w.square()
    kxx = (xx * z2 - 2 * xz * cx * cz + zz * cx * cx - xx * zz + xz * xz) * (w2 * fx * fx)
    kyy = (yy * z2 - 2 * yz * cy * cz + zz * cy * cy - yy * zz + yz * yz) * (w2 * fy * fy)
    kxy = (xy * z2 - (yz * cx + xz * cy) * cz + zz * cx * cy - xy * zz + xz * yz) * (w2 * fx * fy)
    kxu = (zz * cx - xz * cz) * (w2 * fx)
    kyu = (zz * cy - yz * cz) * (w2 * fy)
    shear, slope_y = kxy / kyy, kyu / kyy
    dx = kxx - kxy * shear
    slope_x = (kxu - kxy * slope_y) / dx
    return Outlines(
        x=(cx * cz - xz) * w * fx + k[0, 2],
        y=(cy * cz - yz) * w * fy + k[1, 2],
        u=cz * w,
        high=torch.where(visible, kyy.clamp(min=0).sqrt(), -1.0),
        wide=kxx.clamp(min=0).sqrt(),
        shear=shear,
        dx=dx,
        slope_y=slope_y,
        slope_x=slope_x,
        du=zz * w2 - kyu * slope_y - slope_x.square() * dx,
    )


def _surface(o: Outlines, e: int, x: Tensor, y: Tensor) -> Tensor:
    """(N, H, W) inverse depth of ellipsoid e at columns x and rows y (pixels); NaN outside."""
    c = [field[:, e, None, None] for field in o]
    x0, y0, u, high, _, shear, dx, slope_y, slope_x, du = c
    dy = y - y0
    t = x - (x0 + shear * dy)
    peak = du * (1 - (dy / high).square())
    below = torch.addcmul(peak, t * (-du / dx), t)
    # What is not drawn has a negative height: a NaN here is a miss there.
    return torch.where(high > 0, u + slope_y * dy + slope_x * t + below.sqrt(), torch.nan)


class TorchScorer:
    """Screen boxes and inverse depth in eager torch, in chunks of bounded memory."""

    name = "torch"

    def __init__(self, shape: HandShape) -> None:
        """shape: on the device of the states to come."""
        self.shape = shape
        self.surface = hand_surface(shape)

    def __call__(self, states: Tensor, evidence: Evidence) -> Counts:
        """See Scorer; particles whose state is not finite count 0."""
        states = states.detach().float()
        finite = states.isfinite().all(1)
        states = torch.where(finite[:, None], states, 0.0)
        drawn = outlines(
            self.surface.pose(forward_kinematics(states, self.shape)), evidence.k.float()
        )
        # A state that is not finite is drawn nowhere.
        drawn = drawn._replace(high=torch.where(finite[:, None], drawn.high, -1.0))
        step = max(1, _CHUNK_PIXELS[states.device.type] // evidence.hand.numel())
        counts = [
            _score(Outlines(*(field[first : first + step] for field in drawn)), evidence)
            for first in range(0, len(states), step)
        ]
        return Counts(*(torch.cat(counts, 1) if counts else states.new_zeros(4, 0)))


def rendered_depths(states: Tensor, shape: HandShape, evidence: Evidence) -> Tensor:
    """(N, H, W) Z in m of N > 0 hands (N, 27) as the evidence's camera sees them, 0 = none."""
    shape = shape.to(states.device)
    drawn = outlines(hand_surface(shape).pose(forward_kinematics(states, shape)), evidence.k)
    height, width = evidence.hand.shape
    boxes, (left, top, right, bottom) = _boxes(drawn, width, height)
    image = drawn.x.new_zeros(len(states), height, width)
    if right > left and bottom > top:
        u = _inverse_depth(drawn, boxes, (left, top, right, bottom))
        image[:, top:bottom, left:right] = torch.where(u > 0, 1 / u, 0.0)
    return image


def _score(o: Outlines, evidence: Evidence) -> Tensor:
    """(4, N) counts of one chunk."""
    height, width = evidence.hand.shape
    boxes, box = _boxes(o, width, height)
    left, top, right, bottom = box
    if right <= left or bottom <= top:
        return o.x.new_zeros(4, len(o.x))
    u = _inverse_depth(o, boxes, box)
    inside = evidence.cropped(*box)
    correct, false, residual = compare(u, inside)

    # Where a hand pixel can be missed: the box and the neighbourhood around it.
    reach = min(math.ceil(evidence.radius_px), height + width)
    first = (max(0, left - reach), max(0, top - reach))
    outer = (*first, min(width, right + reach), min(height, bottom + reach))
    margins = (left - outer[0], outer[2] - right, top - outer[1], outer[3] - bottom)
    model = F.pad(u > 0, margins)
    hand = evidence.hand[outer[1] : outer[3], outer[0] : outer[2]]
    missed = dilate_disc(model, evidence.radius_px) & ~model & hand & ~_wrist(o, outer)
    counts = [image.sum((1, 2)).float() for image in (correct, false, missed, residual)]
    return torch.stack(counts)


class _Boxes(NamedTuple):
    """first_x, first_y: (N, E) pixels.  sizes: for each ellipsoid the widest and highest box."""

    first_x: Tensor
    first_y: Tensor
    sizes: list[tuple[int, int]]


def _boxes(o: Outlines, width: int, height: int) -> tuple[_Boxes, tuple[int, int, int, int]]:
    """Screen boxes of the hand's ellipsoids, and the box around all of them, in the image."""
    drawn = (o.high > 0)[:, :-1]
    firsts, edges = [], []
    for middle, half, size in ((o.x, o.wide, width), (o.y, o.high, height)):
        middle, half = middle[:, :-1], half[:, :-1]
        first = (middle - half).ceil().nan_to_num().clamp(0, size)
        last = ((middle + half).floor() + 1).nan_to_num().clamp(0, size)
        last = torch.where(drawn, last, first)
        empty = last <= first
        firsts.append(first)
        edges.append((last - first).amax(0))
        edges.append(torch.where(empty, size, first).amin().expand(1))
        edges.append(torch.where(empty, 0, last).amax().expand(1))
    # The one transfer to the host.
    numbers = torch.cat(edges).long().tolist()
    count = drawn.shape[1]
    wide, (left, right), rest = numbers[:count], numbers[count : count + 2], numbers[count + 2 :]
    high, (top, bottom) = rest[:count], rest[count:]
    sizes = list(zip(wide, high, strict=True))
    return _Boxes(firsts[0], firsts[1], sizes), (left, top, right, bottom)


def _inverse_depth(o: Outlines, boxes: _Boxes, box: tuple[int, int, int, int]) -> Tensor:
    """(N, H, W) largest inverse depth in the box, 0 = none.

    Each ellipsoid is drawn in boxes of one size at each particle's own place, which may reach
    over the right and lower edge: the images are that much larger.
    """
    left, top, right, bottom = box
    n = len(o.x)
    stride = right - left + max(wide for wide, _ in boxes.sizes)
    rows = bottom - top + max(high for _, high in boxes.sizes)
    image = o.x.new_zeros(n, rows * stride)
    for e, (wide, high) in enumerate(boxes.sizes):
        if not (wide and high):
            continue
        x = boxes.first_x[:, e, None, None].clamp(left, right) + _range(wide, image)
        y = boxes.first_y[:, e, None, None].clamp(top, bottom) + _range(high, image)[:, None]
        new = _surface(o, e, x, y).flatten(1)
        at = ((y - top) * stride + (x - left)).flatten(1).long()
        image.scatter_(1, at, torch.fmax(image.gather(1, at), new))
    return image.view(n, rows, stride)[:, : bottom - top, : right - left]


def _range(size: int, like: Tensor) -> Tensor:
    return torch.arange(size, device=like.device, dtype=like.dtype)


def _wrist(o: Outlines, box: tuple[int, int, int, int]) -> Tensor:
    """(N, H, W) bool: the silhouette of the last ellipsoid in the box."""
    left, top, right, bottom = box
    y = top + _range(bottom - top, o.x)[:, None]
    return ~_surface(o, -1, left + _range(right - left, o.x), y).isnan()
