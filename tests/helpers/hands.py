"""Estimates of hands that nobody tracked, whole as the tracker's, for what shows or sends them."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch

from toftrack.frames.estimate import Estimate, no_estimate
from toftrack.hand.conventions import in_all_conventions
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import ANGLE_NAMES, forward_kinematics

K = np.array([[200.0, 0, 87.5], [0, 200.0, 71.5], [0, 0, 1]])
SIZE_PX = 176, 144
_FLEXIONS = [6 + i for i, name in enumerate(ANGLE_NAMES) if "flexion" in name]


_shape = cache(default_hand_shape)  # one object a side, of which what follows from it is kept


def hand_estimate(index: int, side: str = "right", bent: float = 0.0, **changes: Any) -> Estimate:
    """A hand half a metre away with its palm to the camera, moving to the right with the frames.

    bent: rad, of each joint.  changes: of other fields.
    """
    state = np.zeros(27, np.float32)
    state[:3] = -0.05 + 0.001 * index, 0.08, 0.5
    state[_FLEXIONS] = bent
    shape = _shape(side=side)
    joints = forward_kinematics(torch.from_numpy(state)[None], shape).joints_m[0].numpy()
    first = no_estimate(index, index / 25, "tracking", 4, 0.01)
    whole = replace(
        first,
        lost=False,
        state=state,
        joints_m=joints,
        confidence=0.9,
        joint_ok=np.ones(21, bool),
        side=side,
        side_probability=1.0,
        gesture="palm",
        gesture_probability=0.8,
        pinch=0.25,
    )
    return replace(in_all_conventions(whole, shape, K, SIZE_PX), **changes)


def lost_hand(index: int) -> Estimate:
    """A frame before any hand was found."""
    return no_estimate(index, index / 25, "lost", 4, 0.01)
