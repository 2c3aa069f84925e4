"""Poses to try beside the one that was found: single fingers that jump."""

from __future__ import annotations

import torch
from torch import Tensor

from toftrack.hand.skeleton import ANGLE_NAMES, FINGERS

FINGER_OF_ANGLE = [FINGERS.index(name.split("_")[0]) for name in ANGLE_NAMES]
"""Of each of the 21 angles, 0 = thumb."""


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
    of_angle = torch.tensor(FINGER_OF_ANGLE, device=device)
    tried = state.repeat(n + 1, 1)
    tried[1:, 6:] = torch.where(of_angle == fingers[:, None], poses[rows], tried[1:, 6:])
    return tried


def exchange_fingers(state: Tensor, poses: Tensor) -> Tensor:
    """Copies of the state, one finger of each taken from one of the poses, every finger of each.

    state: (1, 27).  poses: (M, 21) joint angles.  Returns (5 M, 27).
    """
    of_angle = torch.tensor(FINGER_OF_ANGLE, device=state.device)
    chosen = of_angle == torch.arange(len(FINGERS), device=state.device)[:, None]  # (5, 21)
    angles = torch.where(chosen, poses[:, None], state[:, None, 6:]).flatten(0, 1)
    return torch.cat((state[:, :6].expand(len(angles), 6), angles), 1)
