"""The range image of an estimate (paper, fig. 3)."""

from __future__ import annotations

import functools

import numpy as np
import torch

from toftrack.compute.compiling import entry_point
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import Ellipsoids, HandSurface, hand_surface
from toftrack.render.closed_form import project, screen_boxes


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

    As `render_range_images`, but each ellipsoid is drawn within its own box only: a view that draws
    every frame must not take longer than the tracker.

    ellipsoids: (1, E).  k: (3, 3).
    """
    conics = project(ellipsoids)
    k = np.asarray(k, np.float32)
    # One more pixel all around than the outline needs, which rounding could move.
    boxes = screen_boxes(conics, torch.from_numpy(k), height, width)[0].numpy()
    x = (np.arange(width, dtype=np.float32) - k[0, 2]) / k[0, 0]
    y = (np.arange(height, dtype=np.float32) - k[1, 2]) / k[1, 1]
    linear, quadratic = conics.linear[0].numpy(), conics.quadratic[0].numpy()
    image = np.zeros((height, width), np.float32)
    _draw(linear, quadratic, boxes.astype(np.int64), x, y, image)
    return image


@entry_point(__file__)
def _draw(
    linear: np.ndarray,
    quadratic: np.ndarray,
    boxes: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    image: np.ndarray,
) -> None:
    """Z of the nearest of E ellipsoids, into an image of zeros.

    linear: (E, 3) and quadratic: (E, 3, 3) of their inverse depths, see closed_form.
    boxes: (E, 4) left, right, top, bottom.  x, y: slopes of the columns' and rows' rays.
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
