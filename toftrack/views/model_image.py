"""The range image of an estimate (paper, fig. 3)."""

from __future__ import annotations

import numpy as np
import torch

from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import Ellipsoids, hand_surface
from toftrack.render.closed_form import render_range_images


def model_range_image(
    state: np.ndarray, shape: HandShape, k: np.ndarray, height: int, width: int
) -> np.ndarray:
    """The surface of a hand without its forearm, (H, W) float32 metres, 0 = none.

    state: (27,); where it is NaN there was no estimate, and the image is empty.  k: (3, 3).
    """
    if not np.isfinite(state).all():
        return np.zeros((height, width), np.float32)
    shape = shape.to("cpu")
    posed = forward_kinematics(torch.from_numpy(np.asarray(state, np.float32))[None], shape)
    both = hand_surface(shape).pose(posed)
    hand = Ellipsoids(both.centres_m[:, :-1], both.axes_m[:, :-1])
    k_t = torch.from_numpy(np.asarray(k, np.float32))
    return render_range_images(hand, k_t, height, width)[0].numpy()
