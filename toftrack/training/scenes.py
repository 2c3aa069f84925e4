"""Scenes to train on: a raised hand with its arm, the person, another hand, things, a room.

Everything is drawn at random for a batch at once, as skins, ellipsoids with a label each, things of
simple parts, and planes. All lengths are metres in the camera frame of the picture that will be
taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from toftrack.training.dice import Dice
from toftrack.training.hands import ABOVE, BACKGROUND, FRONT, HEAD, THING, Hands, turn


@dataclass(frozen=True, eq=False)
class Scenes:
    """What a batch of pictures is taken of.

    centres_m, axes_m: (N, M, 3), (N, M, 3, 3) ellipsoids.  labels: (N, M), -1 = there is none.
    planes: (N, P, 4): points X with n.X = d, as (n, d); d = inf is none.
    skinned: (N, M) ellipsoids that a skin is drawn instead of.
    skins: (N, S, K, PRIMITIVE) of S hands, see skin.Skins.  skin_labels: (N, S, K) of their
        primitives, -1 = none.  skin_widths_m: (N, S, 2) how far each blends and lies outside.
    parts: (N, Q, PART) of things, see things_numba.
    """

    centres_m: Tensor
    axes_m: Tensor
    labels: Tensor
    planes: Tensor
    skinned: Tensor
    skins: Tensor
    skin_labels: Tensor
    skin_widths_m: Tensor
    parts: Tensor


def moved(scenes: Scenes, by_m: Tensor) -> Scenes:
    """The same scenes elsewhere; by_m: (N, 3)."""
    planes = scenes.planes.clone()
    planes[..., 3] += (planes[..., :3] * by_m[:, None]).sum(-1)
    parts, skins = scenes.parts.clone(), scenes.skins.clone()
    parts[..., 1:4] += by_m[:, None]
    skins[..., :3] += by_m[:, None, None]
    centres = scenes.centres_m + by_m[:, None]
    return replace(scenes, centres_m=centres, planes=planes, skins=skins, parts=parts)


def surroundings(hands: Hands, dice: Dice, views: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The person behind a raised hand: upper arm, torso, head; (N, B, 3), (N, B, 3, 3), (N, B).

    views: (N,) where the cameras are. From the head nothing is seen of the person, from above
    seldom.
    """
    n = len(views)
    away = torch.tensor([0.0, -0.35, 0.8]) + 0.6 * dice.normal(n, 3)
    away = torch.nn.functional.normalize(away, dim=1)
    shoulder = hands.elbow_m + 0.27 * away
    side = torch.where(dice.chance(0.5, n), 1.0, -1.0)
    torso = shoulder + torch.stack(
        (0.19 * side, 0.26 + 0.03 * dice.normal(n), 0.03 * dice.normal(n)), 1
    )
    head = torso + torch.stack(
        (0.03 * dice.normal(n), -0.47 + 0.03 * dice.normal(n), -0.02 + 0.03 * dice.normal(n)), 1
    )
    # A hand before the face or the chest, as one holds it up to be seen.
    before = dice.uniform(n)
    gap = hands.pivot_m[:, 2] + dice.uniform(n, low=0.03, high=0.45)
    lateral = hands.pivot_m[:, :2] + 0.07 * dice.normal(n, 2)
    face = torch.cat((lateral, (gap + 0.10)[:, None]), 1)
    chest = torch.cat((lateral + torch.tensor([0.0, 0.05]), (gap + 0.12)[:, None]), 1)
    moved_head = torch.where((before < 0.18)[:, None], face - head, torch.zeros(3))
    moved_chest = torch.where((before > 0.70)[:, None], chest - torso, torch.zeros(3))
    shift = moved_head + moved_chest
    # And never in front of the hand.
    nearest = (torso + shift)[:, 2] - 0.13
    shift[:, 2] += (hands.pivot_m[:, 2] + 0.03 - nearest).clamp(min=0)
    torso, head, shoulder = torso + shift, head + shift, shoulder + shift
    neck = torso + torch.stack((torch.zeros(n), torch.full((n,), -0.33), torch.zeros(n)), 1)
    other = torso + torch.stack((0.22 * side, torch.full((n,), 0.1), torch.zeros(n)), 1)
    upper = (hands.elbow_m + shoulder) / 2
    centres = torch.stack((torso, head, neck, upper, other, shoulder), 1)
    stout = 1 + 0.15 * dice.normal(n, 1)
    straight = torch.eye(3).expand(n, 3, 3) @ turn(0.15 * dice.normal(n), 2)
    arm = hands.elbow_m - shoulder
    arm_axes = _along(arm, 0.045 * stout[:, 0], (0.5 * arm.norm(dim=1) + 0.02).clamp(max=0.35))
    sizes = torch.tensor([[0.19, 0.30, 0.12], [0.075, 0.11, 0.095], [0.05, 0.09, 0.05]])
    body_axes = straight[:, None] * (sizes * stout[..., None])[:, :, None, :]
    hanging = straight * torch.tensor([0.05, 0.20, 0.05])
    ball = straight * torch.tensor([0.07, 0.07, 0.07])
    axes = torch.cat((body_axes, arm_axes[:, None], hanging[:, None], ball[:, None]), 1)
    there = dice.chance(0.7, n)
    there &= (views == FRONT) | ((views == ABOVE) & dice.chance(0.25, n))
    labels = torch.where(there[:, None], BACKGROUND, -1).expand(n, 6).clone()
    labels[:, 3] = torch.where(there & (arm.norm(dim=1) < 0.5), BACKGROUND, -1)
    return centres, axes, labels


def _along(direction: Tensor, radius: Tensor, half_length: Tensor) -> Tensor:
    """(N, 3, 3) semi-axes of ellipsoids of revolution along (N, 3)."""
    y = torch.nn.functional.normalize(direction, dim=1)
    across, _, away = torch.eye(3)
    helper = torch.where(y[:, :1].abs() < 0.7, across, away)
    x = torch.nn.functional.normalize(torch.linalg.cross(y, helper), dim=1)
    z = torch.linalg.cross(x, y)
    scales = torch.stack((radius, half_length, radius), 1)
    return torch.stack((x, y, z), 2) * scales[:, None, :]


def things(around_m: Tensor, n_things: int, p: float, dice: Dice) -> tuple[Tensor, Tensor, Tensor]:
    """Bars, plates, bottles and balls about (N, 3), most of them in front of it."""
    n = len(around_m)
    spread = torch.tensor([0.09, 0.09, 0.0])
    nearer = torch.where(
        dice.chance(0.75, n, n_things),
        dice.uniform(n, n_things, low=-0.20, high=-0.045),
        dice.uniform(n, n_things, low=0.05, high=0.4),
    )
    offset = spread * dice.normal(n, n_things, 3)
    offset[..., 2] = nearer
    log_axes = dice.uniform(n, n_things, 3, low=math.log(0.006), high=math.log(0.12))
    rotation = dice.rotations(n * n_things).view(n, n_things, 3, 3)
    flat = dice.chance(0.5, n, n_things)[..., None, None]
    rotation = torch.where(flat, torch.eye(3), rotation)
    labels = torch.where(dice.chance(p, n, n_things), THING, -1)
    return around_m[:, None] + offset, rotation * log_axes.exp()[..., None, :], labels


def background_behind(behind_m: Tensor, dice: Dice) -> Tensor:
    """(N, 2, 4) a wall behind everything, and sometimes a table.

    behind_m: (N,) how far away the hands are, and a little more.
    """
    n = len(behind_m)
    wall = torch.cat((0.2 * dice.normal(n, 2), torch.ones(n, 1)), 1)
    wall = torch.nn.functional.normalize(wall, dim=1)
    distance = behind_m + dice.uniform(n, low=0.15, high=1.5)
    distance = torch.where(dice.chance(0.2, n), torch.inf, distance)
    table = torch.cat((0.1 * dice.normal(n, 1), torch.ones(n, 1), 0.4 * dice.normal(n, 1)), 1)
    table = torch.nn.functional.normalize(table, dim=1)
    below = dice.uniform(n, low=0.12, high=0.4)
    below = torch.where(dice.chance(0.15, n), below, torch.inf)
    planes = torch.cat((wall, distance[:, None]), 1), torch.cat((table, below[:, None]), 1)
    return torch.stack(planes, 1)


def tables_under(hands: Hands, views: Tensor, dice: Dice) -> Tensor:
    """(N, 1, 4) the tables that cameras see which look down, under the hands; others see none.

    views: (N,) where the cameras are. From above, hands often lie on the table.
    """
    n = len(views)
    above = torch.cat((0.1 * dice.normal(n, 2), torch.ones(n, 1)), 1)
    tilt = dice.uniform(n, 1, low=0.3, high=1.2)
    head = torch.cat((0.1 * dice.normal(n, 1), tilt, torch.ones(n, 1)), 1)
    normal = torch.where((views == ABOVE)[:, None], above, head)
    normal = torch.nn.functional.normalize(normal, dim=1)
    points = torch.cat((hands.joints_m, hands.elbow_m[:, None]), 1)
    # Joints lie a finger's half thickness above what the hand lies on.
    lowest = (points * normal[:, None]).sum(-1).amax(1) + 0.010
    reach = torch.where(views == ABOVE, 0.25, 0.5)
    distance = lowest + reach * dice.uniform(n).square()
    seen = (views == ABOVE) | ((views == HEAD) & dice.chance(0.75, n))
    distance = torch.where(seen, distance, torch.inf)
    return torch.cat((normal, distance[:, None]), 1)[:, None]
