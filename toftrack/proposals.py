"""Steps between one frame's pose and the next: fingers that jump, and rest that should be still."""

from __future__ import annotations

import torch
from torch import Tensor

from toftrack import filter as sir
from toftrack.hand.skeleton import ANGLE_NAMES, FINGERS

_FINGER_OF_ANGLE = [FINGERS.index(name.split("_")[0]) for name in ANGLE_NAMES]


def swap_fingers(state: Tensor, poses: Tensor, n: int, generator: torch.Generator) -> Tensor:
    """The state followed by n copies of it, one finger of each taken from another pose.

    A finger that was lost is bent where it should be straight, or the other way round; between the
    two the seen points lie too far from the surface for Gauss-Newton to be drawn to them.

    state: (1, 27).  poses: (M, 21) joint angles to take fingers from, such as the training poses.
    Returns (n + 1, 27).
    """
    device = state.device
    rows = torch.randint(len(poses), (n,), generator=generator, device=device)
    fingers = torch.randint(len(FINGERS), (n,), generator=generator, device=device)
    of_angle = torch.tensor(_FINGER_OF_ANGLE, device=device)
    tried = state.repeat(n + 1, 1)
    tried[1:, 6:] = torch.where(of_angle == fingers[:, None], poses[rows], tried[1:, 6:])
    return tried


def steadied(state: Tensor, before: Tensor, still: tuple[float, float, float]) -> Tensor:
    """Take less of a change the more it looks like noise, so that a still hand does not jitter.

    Of a change of size c in translation, rotation or a finger's angles, c^2 / (c^2 + s^2) is taken,
    s being the noise of that group: nearly all of a movement, little of a tremble.

    state, before: (1, 27).  still: s of translation (m), rotation (rad) and a finger (rad).
    """
    change = sir.difference(state, before)
    of_angle = torch.tensor(_FINGER_OF_ANGLE, device=state.device)
    group = torch.cat((of_angle.new_tensor([5, 5, 5, 6, 6, 6]), of_angle))
    square = change.new_zeros(7).index_add(0, group, change[0].square())
    noise = change.new_tensor([still[2]] * 5 + [still[0], still[1]]).square()
    part = square / (square + noise).clamp(min=1e-12)
    return sir.compose(before, change * part[group])
