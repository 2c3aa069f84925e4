"""From one refined pose to the next: rest should be still, movement should not lag."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.pace import FRAME_S
from toftrack.compute.rigid import Motions
from toftrack.hand.skeleton import ANGLE_NAMES, FINGERS

_GROUP = np.array([5, 5, 5, 6, 6, 6, *(FINGERS.index(name.split("_")[0]) for name in ANGLE_NAMES)])
"""Of each degree of freedom: the fingers, translation, rotation."""
_NOISE = np.square([0.12] * 5 + [0.003, 0.03])
"""Squared noise of the refined pose of a hand that moves, of all angles of a finger together (rad),
translation (m) and rotation (rad). Smaller changes are mostly noise."""
_CALM = 4.0
"""By how much more, in parts of it, the noise counts while the whole hand rests."""
_MEMORY = 0.85
"""Part of the trend that is kept over FRAME_S; towards 1, rest is told more surely and later."""


def steadied(
    state: Tensor, before: Tensor, trend: Tensor, dt_s: float, motions: Motions
) -> tuple[Tensor, Tensor]:
    """Take less of a change the more it looks like noise, so that a still hand does not tremble.

    Of a change of size c in translation, rotation or a finger's angles, c^2 / (c^2 + s^2) is taken,
    s being the noise of that group: nearly all of a movement, little of a tremble. Noise changes
    its sign from frame to frame and movement does not, so their running mean, the trend, tells the
    two apart (a tracking signal as Trigg's, Oper. Res. Q. 15(3), 1964): while it is small in all
    groups together the hand rests, and s grows.

    state, before: (1, 27) this frame's pose and the last one's, dt_s earlier; all on the CPU.
    trend: (27,) mean change a second as of the last frame; NaN at the start.
    Returns the (1, 27) pose to believe and the trend.
    """
    # In numpy: on 27 numbers each of torch's operations takes longer than its arithmetic.
    change = motions.difference(state, before)[0].numpy()
    speed = change / np.float32(dt_s)
    keep = np.float32(_MEMORY ** (dt_s / FRAME_S))
    before_s = np.where(np.isfinite(trend.numpy()), trend.numpy(), speed)
    mean = speed + keep * (before_s - speed)
    moving = (_size_squared(mean * FRAME_S) / _NOISE).sum()
    # Steep: a still hand's signal stays below 1 in nine frames of ten, a slow movement's above.
    noise = _NOISE * (1 + _CALM / (1 + moving**6)) ** 2
    square = _size_squared(change)
    part = square / (square + noise)
    taken = torch.from_numpy((change * part[_GROUP]).astype(np.float32))
    return motions.compose(before, taken[None]), torch.from_numpy(mean)


def _size_squared(values: np.ndarray) -> np.ndarray:
    """(27,) to (7,), of the groups."""
    return np.bincount(_GROUP, np.square(values), minlength=7)
