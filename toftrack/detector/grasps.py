"""Hands that hold things, to train on: power grasps in the palm and precision grasps of the tips.

Things are boxes, cylinders, cones, cups, mugs, bottles, balls, discs, cards, plates, pens and tools
of a handle and a shaft. Phones and hammers are left out on purpose, so that what a network says of
hands that hold those tells how it does with things that it has never seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toftrack.detector.dice import Dice
from toftrack.detector.grasps_numba import CLOSE, YIELD, grasp
from toftrack.detector.held_things import open_thumbs, things_between_tips, things_in_palms
from toftrack.hand.shape import HandShape
from toftrack.hand.surface import HandSurface
from toftrack.pose_space.base import clamp_to_joint_limits
from toftrack.pose_space.data.shown_poses import shown_poses

POWER_SHARE = 0.52
"""Of all grasps; the others are precision grasps."""
_OPENED_SHARE = 0.12
"""Grasps that are just being opened or closed."""
_THUMB_TRIES = 10
"""Places from which a thumb tries to reach what is held in the palm."""
_OPPOSED_SHARE = 0.5
"""Thumbs that face the palm across what is held in it, if they can."""
_DEEPEST_M = 0.004


@dataclass(frozen=True, eq=False)
class Grasps:
    """N hands with things in the frame of a right hand whose wrist is the origin.

    angles: (N, 21).  parts: (N, Q, PART) of the things.  held: (N,) the fingers touch the thing; a
    hand for which that failed is bare.
    """

    angles: Tensor
    parts: Tensor
    held: Tensor


def random_grasps(shape: HandShape, surface: HandSurface, size: Tensor, dice: Dice) -> Grasps:
    """A grasp for each of N right hands, see ShapeBank.rows; size: (N,) in mean adult's hands."""
    n = len(size)
    power = dice.chance(POWER_SHARE, n)
    radii, shifts = _capsules(surface)
    bare = shown_poses(n, dice.generator)
    palm_angles, palm_parts = things_in_palms(size, dice)
    thumbs = open_thumbs(n, _THUMB_TRIES, dice)
    opposed = dice.chance(_OPPOSED_SHARE, n)
    tip_angles, tip_parts, closing = things_between_tips(shape, radii, shifts, bare, dice)
    angles = torch.where(power[:, None], palm_angles, tip_angles)
    parts = torch.where(power[:, None, None], palm_parts, tip_parts)
    others = torch.where(closing & (parts[:, 0, 0] >= 0), CLOSE, YIELD)[:, None].expand(n, 3)
    tips = torch.cat((torch.full((n, 2), CLOSE), others), 1)
    tasks = torch.where(power[:, None], torch.full((n, 5), CLOSE), tips)
    said = torch.zeros(n, 2, dtype=torch.float64)
    most = torch.tensor([35, 45, 15, 55, 60] + [0, 82, 100, 55] * 4) + 6.0 * dice.normal(n, 21)
    most = clamp_to_joint_limits(torch.deg2rad(most)).double()
    angles, parts = angles.double().contiguous(), parts.double().contiguous()
    flesh = ((0.013 + 0.0015 * dice.normal(n)) * size).double()
    grasp(
        angles.numpy(),
        _doubles(thumbs),
        opposed.numpy(),
        most.numpy(),
        tasks.contiguous().numpy(),
        power.numpy(),
        flesh.numpy(),
        *(_doubles(x) for x in (shape.base_frames, shape.base_m, shape.bone_lengths_m)),
        _doubles(radii),
        _doubles(shifts),
        parts.numpy(),
        said.numpy(),
    )
    held = (said[:, 0] >= 2) & (said[:, 1] < _DEEPEST_M)
    angles, parts = angles.float(), parts.float()
    # Some are about to take or to let go: the fingers are on the way to another pose.
    away = dice.uniform(n, 1, low=0.1, high=0.6) * dice.chance(_OPENED_SHARE, n, 1)
    opened = bare.clone()
    opened[:, 5:] = torch.minimum(opened[:, 5:], angles[:, 5:])
    angles = torch.lerp(angles, opened, away)
    parts[..., 0] = torch.where(held[:, None], parts[..., 0], -1.0)
    return Grasps(clamp_to_joint_limits(angles), parts, held)


def _doubles(tensor: Tensor):
    return tensor.double().contiguous().numpy()


def _capsules(surface: HandSurface) -> tuple[Tensor, Tensor]:
    """(N, 5, 3) radii of the bones' capsules, and how far palmward of the bones they lie."""
    bones = torch.tensor([4 * f + b for f in range(5) for b in range(3)])
    size = surface.axes_m[:, bones].norm(dim=2)
    radii = 0.48 * (size[..., 0] + size[..., 2])
    return radii.unflatten(1, (5, 3)), -surface.centres_m[:, bones, 2].unflatten(1, (5, 3))
