"""The range image of an estimate (paper, fig. 3)."""

from __future__ import annotations

import functools

import numpy as np
import torch

from toftrack.compute.compiling import entry_point
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import Ellipsoids, HandSurface, hand_surface
from toftrack.render.closed_form import _NEAREST_M


@functools.lru_cache(maxsize=4)
def cpu_surface(shape: HandShape) -> HandSurface:
    """The surface of a hand on the CPU, made once for as long as a run keeps the shape."""
    return hand_surface(shape.to("cpu", torch.float32))


def posed_hand(state: np.ndarray, shape: HandShape) -> Ellipsoids:
    """One posed hand, (1, E + 1) ellipsoids on the CPU, the wrist's last.  state: (27,), finite."""
    batch = torch.from_numpy(np.asarray(state, np.float32))[None]
    pose = forward_kinematics(batch, shape.to("cpu", torch.float32))
    return cpu_surface(shape).pose(pose)


def parted(both: Ellipsoids) -> tuple[Ellipsoids, Ellipsoids]:
    """The hand's own ellipsoids, and the wrist's."""
    hand = Ellipsoids(both.centres_m[:, :-1], both.axes_m[:, :-1])
    return hand, Ellipsoids(both.centres_m[:, -1:], both.axes_m[:, -1:])


def range_image(ellipsoids: Ellipsoids, k: np.ndarray, height: int, width: int) -> np.ndarray:
    """Z of the nearest surface of one hand, (H, W) float32 metres, 0 = none.

    As `render_range_images`, but each ellipsoid is drawn within its own box only, in compiled code:
    what draws every frame must not take longer than the tracker.

    ellipsoids: (1, E).  k: (3, 3).
    """
    k = np.asarray(k, np.float32)
    linear, quadratic, boxes = _projected(ellipsoids, k, height, width)
    x = (np.arange(width, dtype=np.float32) - k[0, 2]) / k[0, 0]
    y = (np.arange(height, dtype=np.float32) - k[1, 2]) / k[1, 1]
    image = np.zeros((height, width), np.float32)
    _draw(linear, quadratic, boxes, x, y, image)
    return image


@entry_point
def _draw(linear, quadratic, boxes, x, y, image):
    """Z of the nearest of E ellipsoids, into an image of zeros.

    linear, quadratic, boxes: see _projected.  x, y: slopes of the columns' and rows' rays.
    """
    height, width = image.shape
    for e in range(len(boxes)):
        left, right, top, bottom = boxes[e]
        if right <= left or bottom <= top:
            continue
        line, q = linear[e], quadratic[e]
        for row in range(max(0, top - 1), min(height, bottom + 1)):
            py = y[row]
            for column in range(max(0, left - 1), min(width, right + 1)):
                px = x[column]
                square = (q[0, 0] * px + 2 * q[0, 2]) * px + (q[1, 1] * py + 2 * q[1, 2]) * py
                square += q[2, 2] + 2 * q[0, 1] * px * py
                if square >= 0:
                    u = line[0] * px + line[1] * py + line[2] + np.sqrt(square)
                    image[row, column] = max(image[row, column], u)
    for row in range(height):
        for column in range(width):
            if image[row, column] > 0:
                image[row, column] = 1 / image[row, column]


def _projected(
    ellipsoids: Ellipsoids, k: np.ndarray, height: int, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linear (E, 3) and quadratic (E, 3, 3) parts of inverse depths, as closed_form.project, which
    takes as long for one hand as all the drawing; and boxes (E, 4): left, right, top, bottom.
    """
    centres, axes = ellipsoids.centres_m[0].numpy(), ellipsoids.axes_m[0].numpy()
    turned = axes.swapaxes(1, 2)
    whiten = turned / np.square(axes).sum(1)[..., None]
    s = (whiten @ centres[..., None])[..., 0]
    visible = centres[:, 2] - np.sqrt(np.square(axes[:, 2]).sum(1)) > _NEAREST_M
    g = np.where(visible, np.square(s).sum(1) - 1, np.float32(1))[:, None]
    back = whiten.swapaxes(1, 2)
    linear = (back @ s[..., None])[..., 0] / g
    quadratic = linear[..., None] * linear[:, None] - back @ whiten / g[..., None]
    dual = axes @ turned - centres[..., None] * centres[:, None]
    size = np.array([width, height], np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = dual[:, :2, 2] / dual[:, 2:, 2]
        own = dual[:, [0, 1], [0, 1]] / dual[:, 2:, 2]
        spread = np.sqrt(np.maximum(np.square(mean) - own, 0))
        focal, middle = k[[0, 1], [0, 1]], k[:2, 2]
        low = np.ceil(focal * (mean - spread) + middle).clip(0, size)
        high = (np.floor(focal * (mean + spread) + middle) + 1).clip(0, size)
    high = np.where(visible[:, None], high, low)
    boxes = np.stack((low[:, 0], high[:, 0], low[:, 1], high[:, 1]), 1)
    return linear, quadratic, np.nan_to_num(boxes, nan=0).astype(np.int64)


def model_range_image(
    state: np.ndarray, shape: HandShape, k: np.ndarray, height: int, width: int
) -> np.ndarray:
    """The surface of a hand without its forearm, (H, W) float32 metres, 0 = none.

    state: (27,); where it is NaN there was no estimate, and the image is empty.  k: (3, 3).
    """
    if not np.isfinite(state).all():
        return np.zeros((height, width), np.float32)
    hand, _ = parted(posed_hand(state, shape))
    return range_image(hand, k, height, width)
