"""What stands about in rooms and is no hand: bars side by side, boards, clutter, leaves, branches,
heads, and frames.

Nothing else in a room looks so much like fingers, palms and fists.
"""

from __future__ import annotations

import math

import roma
import torch
from torch import Tensor

from toftrack.training.dice import Dice
from toftrack.training.held_things import make_part
from toftrack.training.things_numba import BALL, BOX, CONE

PIECES = 9
"""Parts of the furniture in an image."""
_OFTEN = 2.0, 2.0, 2.0, 2.0, 1.0, 3.0, 3.0
"""How often each kind of furniture stands there, in parts of their sum."""


def before_camera(n: int, dice: Dice) -> Tensor:
    """(N, 3) where furniture may stand, in metres in the camera frame."""
    z = dice.uniform(n, low=0.4, high=1.2)
    at = torch.tensor([0.22, 0.18]) * dice.normal(n, 2)
    return torch.cat((z[:, None] * at, z[:, None]), 1)


def furniture(there: Tensor, middle: Tensor, dice: Dice) -> Tensor:
    """(N, PIECES, PART) of one kind each about (N, 3); there: (N,) where there is any."""
    n = len(there)
    makers = (_bars, _boards, _clutter, _leaves, _branches, _heads, frames)
    kinds = torch.stack([make(middle, dice) for make in makers])
    often = torch.tensor(_OFTEN).expand(n, -1)
    which = torch.multinomial(often, 1, generator=dice.generator)[:, 0]
    pieces = kinds[which, torch.arange(n)]
    some = dice.uniform(n, 1, low=2, high=PIECES + 1).floor()
    shown = (torch.arange(PIECES) < some) & there[:, None]
    pieces[..., 0] = torch.where(shown, pieces[..., 0], -1.0)
    return pieces


def on_a_piece(pieces: Tensor, dice: Dice) -> Tensor:
    """(N, 3) a place on one of the pieces, as often at an end of it as between; pieces: as
    furniture gives them.
    """
    n = len(pieces)
    weights = (pieces[..., 0] >= 0) + 1e-6  # where there is no piece, any place does
    one = torch.multinomial(weights, 1, generator=dice.generator)[:, 0]
    piece = pieces[torch.arange(n), one]
    place, rows, sizes = piece[:, 1:4], piece[:, 4:13].unflatten(1, (3, 3)), piece[:, 13:16]
    balls, cones = piece[:, :1] == BALL, piece[:, :1] == CONE
    sizes = torch.where(balls, sizes[:, :1], torch.where(cones, sizes[:, [0, 2, 1]], sizes))
    along = (1.6 * dice.uniform(n, 3, low=-1.0, high=1.0)).clamp(-1, 1)
    return place + ((sizes * along)[:, None] @ rows)[:, 0]


def _standing(n: int, dice: Dice) -> Tensor:
    """(N, 3, 3) rotations, y nearly along the image's; a third lies or leans."""
    lean = torch.where(dice.chance(0.33, n, 1), 1.2, 0.15)
    most = torch.cat((lean, torch.full((n, 1), 1.5), lean), 1)
    return roma.rotvec_to_rotmat(most * dice.normal(n, 3))


def _in_row(middle: Tensor, rows: Tensor, axis: int, gap: Tensor, number: int) -> Tensor:
    """(N, 3) the place of one of PIECES along an axis of a rotation."""
    return middle + (number - (PIECES - 1) / 2) * gap[:, None] * rows[:, axis]


def _bars(middle: Tensor, dice: Dice) -> Tensor:
    """As of a chair's back or a rack, with a board across."""
    n = len(middle)
    rows = _standing(n, dice)
    radius, half = dice.uniform(n, low=0.005, high=0.02), dice.uniform(n, low=0.06, high=0.4)
    gap = 2 * radius + dice.uniform(n, low=0.005, high=0.08)
    sizes, across = (radius, radius, half), (PIECES / 2 * gap, radius + 0.02, radius)
    board = make_part(BOX, middle - half[:, None] * rows[:, 1], rows, across)
    bars = [
        make_part(CONE, _in_row(middle, rows, 0, gap, number), rows, sizes)
        for number in range(PIECES - 1)
    ]
    return torch.stack((board, *bars), 1)


def _boards(middle: Tensor, dice: Dice) -> Tensor:
    """As of a shelf, a table or books."""
    n = len(middle)
    rows = _standing(n, dice)
    gap = dice.uniform(n, low=0.03, high=0.3)
    boards = []
    for number in range(PIECES):
        half = torch.exp(dice.uniform(n, 3, low=math.log(0.03), high=math.log(0.35)))
        half[:, 1] = dice.uniform(n, low=0.003, high=0.02)
        place = _in_row(middle, rows, 1, gap, number) + 0.05 * dice.normal(n, 3)
        boards.append(make_part(BOX, place, rows, half))
    return torch.stack(boards, 1)


def _clutter(middle: Tensor, dice: Dice) -> Tensor:
    """Boxes, cups and balls."""
    n = len(middle)
    spread = dice.uniform(n, 1, low=0.05, high=0.35)
    pieces = []
    for number in range(PIECES):
        sizes = 0.036 * torch.exp(0.55 * dice.normal(n, 3).clamp(-2, 2))
        place = middle + spread * torch.tensor([1.0, 0.4, 1.0]) * dice.normal(n, 3)
        kind = (BOX, CONE, BALL)[number % 3]
        pieces.append(make_part(kind, place, _standing(n, dice), sizes))
    order = torch.randperm(PIECES, generator=dice.generator)
    return torch.stack(pieces, 1)[:, order]


def _leaves(middle: Tensor, dice: Dice) -> Tensor:
    """As of a plant, a fan or cables."""
    n = len(middle)
    reach = dice.uniform(n, 1, low=0.03, high=0.15)
    leaves = []
    for _ in range(PIECES):
        wide, long = dice.uniform(n, low=0.004, high=0.035), dice.uniform(n, low=0.02, high=0.10)
        half = (wide, long, dice.uniform(n, low=0.001, high=0.006))
        place = middle + reach * dice.normal(n, 3)
        leaves.append(make_part(BOX, place, dice.rotations(n), half))
    return torch.stack(leaves, 1)


def _branches(middle: Tensor, dice: Dice) -> Tensor:
    """As of toys, twigs or taps: round limbs from one place in all directions."""
    n = len(middle)
    flat = torch.where(dice.chance(0.5, n, 1), 0.3, 1.0)
    thick, long = dice.uniform(n, low=0.004, high=0.018), dice.uniform(n, low=0.03, high=0.14)
    plane = dice.rotations(n)
    core = thick * dice.uniform(n, low=1.0, high=3.0)
    pieces = [make_part(BALL, middle, plane, (core, 0 * core, 0 * core))]
    for _ in range(PIECES - 1):
        squeezed = torch.cat((dice.normal(n, 2), flat * dice.normal(n, 1)), 1)
        along = torch.nn.functional.normalize((squeezed[:, None] @ plane)[:, 0], dim=1)
        half = 0.5 * long * dice.uniform(n, low=0.5, high=1.0) + thick
        radius = thick * dice.uniform(n, low=0.8, high=1.2)
        other = dice.rotations(n)[:, 0]
        x = torch.nn.functional.normalize(torch.linalg.cross(along, other), dim=1)
        rows = torch.stack((x, along, torch.linalg.cross(x, along)), 1)
        sizes = (radius, radius * dice.uniform(n, low=0.6, high=1.0), half)
        place = middle + along * (half + 0.5 * core)[:, None]
        pieces.append(make_part(CONE, place, rows, sizes, 0.55 * radius))
    return torch.stack(pieces, 1)


_HEAD = (
    (CONE, (0, 0.020, -0.020), (0.070, 0.050, 0.105), 0.045),  # the face
    (BALL, (0, -0.035, 0.025), (0.088, 0, 0), 0),  # the back of the skull
    (CONE, (0, 0.020, -0.088), (0.006, 0.016, 0.026), 0.005),  # the nose
    (BOX, (0, -0.018, -0.080), (0.055, 0.010, 0.012), 0.008),  # the brows
    (BALL, (0, 0.105, -0.055), (0.028, 0, 0), 0),  # the chin
    (BOX, (0.078, 0.020, 0.010), (0.008, 0.030, 0.018), 0.006),  # the ears
    (BOX, (-0.078, 0.020, 0.010), (0.008, 0.030, 0.018), 0.006),
    (BALL, (0, -0.055, 0.035), (0.098, 0, 0), 0),  # hair
    (CONE, (0, 0.170, 0.020), (0.052, 0.060, 0.070), 0.010),  # the neck
)
"""Kind, place, sizes and the radius of the edges of a mean head's parts, in metres: x to its left,
y down, z to its back."""


def _heads(middle: Tensor, dice: Dice) -> Tensor:
    """Heads, mostly upright, that look anywhere."""
    n = len(middle)
    lean = torch.tensor([0.2, 0.0, 0.2]) * dice.normal(n, 3)
    yaw = torch.tensor([0.0, 1.0, 0.0]) * dice.uniform(n, 1, low=-math.pi, high=math.pi)
    rows = roma.rotvec_to_rotmat(yaw) @ roma.rotvec_to_rotmat(lean)
    size = torch.exp(0.08 * dice.normal(n, 1))
    pieces = []
    for kind, place, sizes, edge in _HEAD:
        at = size * torch.tensor(place) + 0.006 * dice.normal(n, 3)
        sized = size * torch.tensor(sizes) * torch.exp(0.12 * dice.normal(n, 1))
        offset = (at[:, None] @ rows)[:, 0]
        pieces.append(make_part(kind, middle + offset, rows, sized, torch.full((n,), 0.8 * edge)))
    return torch.stack(pieces, 1)


def frames(middle: Tensor, dice: Dice) -> Tensor:
    """As of a chair's back, a fence or a window: flat slats one way and the other in one plane."""
    n = len(middle)
    rows = _standing(n, dice)
    crossed = rows[:, [1, 0, 2]] * torch.tensor([1.0, 1.0, -1.0])[:, None]
    thick = dice.uniform(n, low=0.004, high=0.015)
    slats = []
    for number in range(PIECES):
        across = number % 2 == 0
        wide = dice.uniform(n, low=0.008, high=0.05)
        half = (wide, dice.uniform(n, low=0.05, high=0.35), thick)
        place = dice.uniform(n, 1, low=-0.25, high=0.25) * rows[:, 1 if across else 0]
        behind = 0.006 * dice.normal(n, 1) * rows[:, 2]
        turned = crossed if across else rows
        slats.append(make_part(BOX, middle + place + behind, turned, half))
    return torch.stack(slats, 1)
