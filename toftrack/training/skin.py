"""The skin of hands to train on: bones and pads joined by a smooth union, as arrays for pictures.

A finger's bone is a round cone (two spheres and what they touch), flattened as its ellipsoid is,
the palm's pads are the surface's ellipsoids, and webs stretch between the roots of neighbouring
fingers. How wide the union blends, how far the skin lies outside, how thick knuckles and finger
tips are differs from hand to hand; a quarter of the hands keeps the ellipsoids as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toftrack.training.dice import Dice

SKIN_SHARE = 0.75
"""How many hands have a skin."""
_LEAST_M, _WIDEST_M = 0.0015, 0.005
"""By how much two surfaces that meet grow where they join."""
_OF_FINGER = 4
"""Ellipsoids of a finger: three bones and a knuckle."""
_WEBS = 3
PRIMITIVE = 17
"""Numbers of a primitive: its place (3), the rows of the matrix into its own frame (9), the two
radii of a cone and its length (3), the sine and cosine of its opening (2). An ellipsoid, a ball of
radius 1 in its own frame, has a length below 0, and its longest half-axis as the first radius.
"""


@dataclass(frozen=True, eq=False)
class Skins:
    """Of N hands, each with P primitives in the camera frame.

    primitives: (N, P, PRIMITIVE).
    source: (P,) the ellipsoid of the hand whose label a primitive takes.
    covered: (N, E) ellipsoids of the hand and its forearm that the skin is drawn instead of.
    used: (N, P) primitives that are drawn where their source is.
    widths_m: (N, 2) by how much surfaces grow where they join, and how far the skin lies outside of
        the union.
    """

    primitives: Tensor
    source: Tensor
    covered: Tensor
    used: Tensor
    widths_m: Tensor

    def labels(self, labels: Tensor) -> Tensor:
        """(N, P) of the primitives, -1 = not drawn, from those of the hand's ellipsoids (N, E)."""
        drawn = self.used & self.covered[:, self.source]
        return torch.where(drawn, labels[:, self.source], -1)


def random_skins(
    centres_m: Tensor, axes_m: Tensor, joints_m: Tensor, bare: Tensor, dice: Dice
) -> Skins:
    """Skins about hands' ellipsoids (N, E, 3), (N, E, 3, 3), see HandSurface, forearms' behind.

    joints_m: (N, 21, 3).  bare: (N, E) what no sleeve covers.
    """
    n, count = bare.shape
    blend = dice.uniform(n, low=_LEAST_M, high=_WIDEST_M)
    # What the union adds where surfaces join is taken off again, more or less.
    outside = dice.uniform(n, low=-0.5, high=0.0) * blend + dice.uniform(n, high=0.001)
    bones = torch.tensor([_OF_FINGER * f + b for f in range(5) for b in range(3)])
    knuckles = torch.arange(3, 5 * _OF_FINGER, _OF_FINGER)
    pads = torch.cat((torch.arange(5 * _OF_FINGER, count), knuckles))
    size = axes_m[:, bones].norm(dim=2)  # (N, 15, 3) half-breadths, half-lengths, half-depths
    primitives = (
        _cones(centres_m[:, bones], axes_m[:, bones], size, joints_m, dice),
        _webs(joints_m, size, dice),
        _ellipsoids(centres_m[:, pads], axes_m[:, pads]),
    )
    source = torch.cat((bones, bones[3::3][:_WEBS], pads))
    used = torch.ones(n, len(source), dtype=torch.bool)
    # The cones hold the knuckles already, so that they are only drawn where they are thick.
    used[:, -len(knuckles) :] = dice.chance(0.3, n, 1)
    covered = bare & dice.chance(SKIN_SHARE, n, 1)
    widths = torch.stack((blend, outside), 1)
    return Skins(torch.cat(primitives, 1), source, covered, used, widths)


def _cones(centres: Tensor, axes: Tensor, size: Tensor, joints: Tensor, dice: Dice) -> Tensor:
    """(N, 15, PRIMITIVE) round cones of the fingers' bones."""
    n = len(centres)
    breadth, depth = size[..., 0], size[..., 2]
    flat = depth / breadth
    unit = axes / size[:, :, None, :]
    of_finger = breadth.unflatten(1, (5, 3))
    bulge = 1.0 + 0.05 * dice.normal(n, 5, 3) + dice.uniform(n, 1, 1, low=-0.03, high=0.10)
    tip = dice.uniform(n, 1, low=0.72, high=0.95) + 0.03 * dice.normal(n, 5)
    middle = 0.5 * (of_finger[..., :2] + of_finger[..., 1:]) * bulge[..., 1:]
    root = of_finger[..., 0] * (1.02 * bulge[..., 0]).clamp(0.9, 1.2)
    end = of_finger[..., 2] * tip.clamp(0.65, 1.0)
    first = torch.cat((root[..., None], middle), 2).flatten(1)
    second = torch.cat((middle, end[..., None]), 2).flatten(1)
    # Along the ellipsoid's own axis, from the proximal joint to the distal one; the last one ends
    # where the finger does.
    chain = joints[:, 1:].unflatten(1, (5, 4))
    start = chain[:, :, :3].flatten(1, 2) - centres
    stop = chain[:, :, 1:].flatten(1, 2) - centres
    along = unit[..., 1]
    low, high = (start * along).sum(-1), (stop * along).sum(-1)
    forward = torch.where(high >= low, 1.0, -1.0)
    low, high = low * forward, high * forward
    along = along * forward[..., None]
    last = torch.zeros(5, 3)
    last[:, 2] = 1
    high = high - last.flatten() * second
    length = (high - low).clamp(min=0.004)
    place = centres + low[..., None] * along
    rows = torch.stack((unit[..., 0], along, unit[..., 2] / flat[..., None]), 2)
    return _packed(place, rows, first, second, length)


def _webs(joints: Tensor, size: Tensor, dice: Dice) -> Tensor:
    """(N, 3, PRIMITIVE) between the roots of neighbouring fingers, along the line between them."""
    n = len(joints)
    part = dice.uniform(n, 1, 1, low=0.16, high=0.40) + 0.02 * dice.normal(n, 3, 1)
    roots, middles = joints[:, 5::4], joints[:, 6::4]
    first = torch.lerp(roots[:, :-1], middles[:, :-1], part)
    second = torch.lerp(roots[:, 1:], middles[:, 1:], part)
    between = second - first
    length = between.norm(dim=-1).clamp(min=1e-4)
    y = between / length[..., None]
    x = torch.nn.functional.normalize(middles[:, :-1] - roots[:, :-1], dim=-1)
    x = torch.nn.functional.normalize(x - (x * y).sum(-1, keepdim=True) * y, dim=-1)
    rows = torch.stack((x, y, torch.linalg.cross(x, y)), 2)
    depth = size[:, 3::3, 2]
    thick = dice.uniform(n, 1, low=0.40, high=0.75)
    radius = thick * 0.5 * (depth[:, :-1] + depth[:, 1:])
    return _packed(first, rows, radius, radius, length)


def _ellipsoids(centres: Tensor, axes: Tensor) -> Tensor:
    """(N, E, PRIMITIVE)."""
    size = axes.norm(dim=2)
    rows = axes.mT / size.square()[..., None]  # the inverse of orthogonal columns
    longest = size.amax(-1)
    return _packed(centres, rows, longest, longest, -torch.ones_like(longest))


def _packed(place: Tensor, rows: Tensor, first: Tensor, second: Tensor, length: Tensor) -> Tensor:
    slope = ((first - second) / length).clamp(-0.95, 0.95)
    numbers = torch.stack((first, second, length, slope, (1 - slope.square()).sqrt()), -1)
    return torch.cat((place, rows.flatten(2), numbers), 2)
