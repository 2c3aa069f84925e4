"""From one refined pose to the next: rest should be still, movement should not lag."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.pace import FRAME_S
from toftrack.compute.rigid import Motions
from toftrack.hand.skeleton import ANGLE_NAMES, FINGERS

_GROUP = np.array([5, 5, 5, 6, 6, 6, *(FINGERS.index(name.split("_")[0]) for name in ANGLE_NAMES)])
"""Of each degree of freedom: the fingers, translation, rotation."""


@dataclass(frozen=True)
class Steadying:
    """How much of a change from frame to frame is believed.

    translation_m, rotation_rad, finger_rad: noise of the refined pose of a hand that moves, in
        translation, rotation and all angles of a finger together. Smaller changes are mostly noise.
    calm: by how much more, in parts of it, the noise counts while the whole hand rests; 0 = none.
    memory: part of the trend that is kept over FRAME_S; towards 1, rest is distinguished from slow
        movement more surely and later.
    """

    translation_m: float = 0.003
    rotation_rad: float = 0.03
    finger_rad: float = 0.12
    calm: float = 4.0
    memory: float = 0.85


def steadied(
    state: Tensor,
    before: Tensor,
    trend: Tensor,
    dt_s: float,
    motions: Motions,
    settings: Steadying = Steadying(),
) -> tuple[Tensor, Tensor]:
    """Take less of a change the more it looks like noise, so that a still hand does not tremble.

    Of a change of size c in translation, rotation or a finger's angles, c^2 / (c^2 + s^2) is taken,
    s being the noise of that group: nearly all of a movement, little of a tremble. Noise changes
    its sign from frame to frame and movement does not, so their running mean, the trend, tells the
    two apart (a tracking signal as Trigg's, Oper. Res. Q. 15(3), 1964): while it is small in all
    groups together the hand rests, and s grows.

    Everything is on the CPU.

    state, before: (1, 27) this frame's pose and the last one's.
    trend: (27,) mean change a second as of the last frame; NaN at the start.
    dt_s: from the last frame to this one.
    Returns the (1, 27) pose to believe and the trend.
    """
    # In numpy: on 27 numbers each of torch's operations takes longer than its arithmetic.
    change = motions.difference(state, before)[0].numpy()
    speed = change / np.float32(dt_s)
    keep = np.float32(settings.memory ** (dt_s / FRAME_S))
    before_s = np.where(np.isfinite(trend.numpy()), trend.numpy(), speed)
    mean = speed + keep * (before_s - speed)
    noise = np.array([settings.finger_rad] * 5 + [settings.translation_m, settings.rotation_rad])
    noise = np.square(np.maximum(noise, 1e-9))
    moving = (_size_squared(mean * FRAME_S) / noise).sum()
    # Steep: a still hand's signal stays below 1 in nine frames of ten, a slow movement's above.
    noise = noise * (1 + settings.calm / (1 + moving**6)) ** 2
    square = _size_squared(change)
    part = square / (square + noise)
    taken = torch.from_numpy((change * part[_GROUP]).astype(np.float32))
    return motions.compose(before, taken[None]), torch.from_numpy(mean)


def _size_squared(values: np.ndarray) -> np.ndarray:
    """(27,) to (7,), of the groups."""
    return np.bincount(_GROUP, np.square(values), minlength=7)
