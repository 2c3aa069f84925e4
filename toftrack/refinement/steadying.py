"""From one refined pose to the next: rest should be still, movement should not lag."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toftrack.checks import check_number
from toftrack.compute.backend import Motions
from toftrack.compute.pace import FRAME_S
from toftrack.refinement.proposals import FINGER_OF_ANGLE


@dataclass(frozen=True)
class Steadying:
    """How much of a change from frame to frame is believed.

    translation_m, rotation_rad, finger_rad: noise of the refined pose of a hand that moves, in
        translation, rotation and all angles of a finger together. Smaller changes are mostly noise.
    calm: by how much more, in parts of it, the noise counts while the whole hand rests; 0 = none.
    memory: part of the trend that is kept over FRAME_S; towards 1, rest is told from slow
        movement more surely and later.
    """

    translation_m: float
    rotation_rad: float
    finger_rad: float
    calm: float
    memory: float

    def __post_init__(self) -> None:
        for name in ("translation_m", "rotation_rad", "finger_rad", "calm"):
            check_number(f"refine.steadying.{name}", getattr(self, name), 0)
        check_number("refine.steadying.memory", self.memory, 0, 1)


def steadied(
    state: Tensor,
    before: Tensor,
    trend: Tensor | None,
    dt_s: float,
    settings: Steadying,
    motions: Motions,
) -> tuple[Tensor, Tensor]:
    """Take less of a change the more it looks like noise, so that a still hand does not tremble.

    Of a change of size c in translation, rotation or a finger's angles, c^2 / (c^2 + s^2) is taken,
    s being the noise of that group: nearly all of a movement, little of a tremble. Noise changes
    its sign from frame to frame and movement does not, so their running mean, the trend, tells the
    two apart (a tracking signal as Trigg's, Oper. Res. Q. 15(3), 1964): while it is small in all
    groups together the hand rests, and s grows.

    state, before: (1, 27) this frame's pose and the last one's.
    trend: (27,) mean change a second as of the last frame; None at the start.
    dt_s: from the last frame to this one.
    Returns the (1, 27) pose to believe and the trend.
    """
    change = motions.difference(state, before)[0]
    speed = change / dt_s
    keep = settings.memory ** (dt_s / FRAME_S)
    trend = speed if trend is None else torch.lerp(speed, trend, keep)
    of_angle = torch.tensor(FINGER_OF_ANGLE, device=state.device)
    group = torch.cat((of_angle.new_tensor([5, 5, 5, 6, 6, 6]), of_angle))

    def size_squared(values: Tensor) -> Tensor:
        return values.new_zeros(7).index_add(0, group, values.square())

    noise = change.new_tensor(
        [settings.finger_rad] * 5 + [settings.translation_m, settings.rotation_rad]
    )
    noise = noise.clamp(min=1e-9).square()
    moving = (size_squared(trend * FRAME_S) / noise).sum()
    # Steep: a still hand's signal stays below 1 in nine frames of ten, a slow movement's above.
    noise = noise * (1 + settings.calm / (1 + moving**6)) ** 2
    square = size_squared(change)
    part = square / (square + noise)
    return motions.compose(before, (change * part[group])[None]), trend
