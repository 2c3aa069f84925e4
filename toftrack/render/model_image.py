"""The range image of an estimate (paper, fig. 3)."""

from __future__ import annotations

import functools

import numpy as np
import torch

from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import Ellipsoids, HandSurface, hand_surface
from toftrack.render.closed_form import project, screen_boxes
from toftrack.render.numba.drawing import draw


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
    conics = project(ellipsoids)
    # One more pixel all around than the outline needs, which rounding could move.
    boxes = screen_boxes(conics, torch.from_numpy(k), height, width)[0].numpy()
    x = (np.arange(width, dtype=np.float32) - k[0, 2]) / k[0, 0]
    y = (np.arange(height, dtype=np.float32) - k[1, 2]) / k[1, 1]
    linear, quadratic = conics.linear[0].numpy(), conics.quadratic[0].numpy()
    image = np.zeros((height, width), np.float32)
    draw(linear, quadratic, boxes.astype(np.int64), x, y, image)
    return image


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
