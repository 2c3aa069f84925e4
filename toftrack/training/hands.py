"""Posed hands to train on, with their forearms, skins and what they hold, as cameras see them.

All lengths are metres in the camera frame of the picture that will be taken. Things are held in
power grasps in the palm and precision grasps of the tips. Phones and hammers are left out on
purpose, so that what a network says of hands that hold those tells how it does with things that it
has never seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import roma
import torch
from torch import Tensor

from toftrack.compute.rigid import PIVOT_M
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import HandSurface
from toftrack.pose_space.base import clamp_to_joint_limits
from toftrack.training.dice import Dice
from toftrack.training.grasps_numba import grasp
from toftrack.training.held_things import (
    PARTS_OF_A_THING,
    open_thumbs,
    things_between_tips,
    things_in_palms,
)
from toftrack.training.shapes import ShapeBank, cupped, rows_of
from toftrack.training.shown_poses import shown_poses
from toftrack.training.skin import Skins, random_skins
from toftrack.training.things_numba import PART

BACKGROUND, HAND, FOREARM, OTHER_FOREARM, OTHER_HAND, THING = range(6)
"""Labels of surfaces."""
FRONT, HEAD, ABOVE = range(3)
"""Where a camera is: before the person, on the head, above a table."""
VIEW_SHARES = (0.68, 0.17, 0.15)
HOLDING = 0.58
"""How many hands hold a thing, or try to."""
UPRIGHT_THUMBS = 0.6
"""How many of those who put a thumb up hold it upright in the image; the others, any way."""
_FOREARM_M = 0.25
_ALONG = 5
"""Ellipsoids along a forearm; one more is a cuff over the back of the hand."""


@dataclass(frozen=True, eq=False)
class Hands:
    """A batch of posed hands.

    pivot_m: (N, 3) middle of the palm.  rotation: (N, 3, 3).  angles: (N, 21).  log_size: (N,).
    left: (N,), see posed_hands.
    joints_m: (N, 21, 3) truth.  elbow_m: (N, 3).
    centres_m, axes_m: (N, E, 3), (N, E, 3, 3) the hand's ellipsoids and the forearm's.
    labels: (N, E), -1 = not drawn.
    skins: drawn instead of some of the ellipsoids.
    parts: (N, Q, PART) of the things that they hold, see things_numba.
    """

    pivot_m: Tensor
    rotation: Tensor
    angles: Tensor
    log_size: Tensor
    left: Tensor
    joints_m: Tensor
    elbow_m: Tensor
    centres_m: Tensor
    axes_m: Tensor
    labels: Tensor
    skins: Skins
    parts: Tensor


def random_views(n: int, dice: Dice) -> Tensor:
    """(n,) where cameras are, by VIEW_SHARES."""
    return torch.multinomial(torch.tensor(VIEW_SHARES), n, True, generator=dice.generator)


def random_rotations(n: int, dice: Dice, views: Tensor | None = None) -> Tensor:
    """(n, 3, 3) hands as people hold them: palms and backs alike, edge-on, at the camera, any.

    views: (n,) where the cameras are; None = before the persons. From the head, the forearm comes
    from below and from the camera; from above, hands lie flat more or less and backs are commoner.
    """
    if views is None:
        views = torch.full((n,), FRONT)
    head, above = views == HEAD, views == ABOVE
    kind = dice.uniform(n)
    upright, sideways, pointing = kind < 0.42, kind < 0.65, kind < 0.85
    roll = 0.6 * dice.normal(n)
    roll = torch.where(sideways & ~upright, dice.uniform(n, low=-2.4, high=2.4), roll)
    roll = torch.where(pointing & ~sideways, 1.0 * dice.normal(n), roll)
    tilt = torch.where(upright, 0.45, 0.7) * dice.normal(n)
    at_camera = 1.25 + 0.4 * dice.normal(n)
    tilt = torch.where(pointing & ~sideways, at_camera, tilt)
    roll = torch.where(head, 0.6 * dice.normal(n), roll)
    roll = torch.where(above, 0.9 * dice.normal(n), roll)
    tilt = torch.where(head, -0.65 + 0.35 * dice.normal(n), tilt)
    tilt = torch.where(above, 0.3 * dice.normal(n), tilt)
    face = dice.uniform(n)
    palms = torch.where(head | above, 0.22, 0.4)
    azimuth = 0.5 * dice.normal(n) + torch.where(face < palms, 0.0, math.pi)
    azimuth = torch.where(face > 0.75, dice.uniform(n, low=-math.pi, high=math.pi), azimuth)
    rotations = [turn(roll, 2), turn(tilt, 0), turn(azimuth, 1)]
    held = rotations[0] @ rotations[1] @ rotations[2]
    return torch.where(pointing[:, None, None], held, dice.rotations(n))


def thumb_is_up(angles: Tensor) -> Tensor:
    """(N,) which of the poses (N, 21) have a straight thumb away from four curled fingers."""
    degrees = torch.rad2deg(angles)
    # A fist closes with bent knuckles, or with middle joints that are bent the more.
    curled = (degrees[:, 7::4] > 65).all(1) & (degrees[:, 6::4] + degrees[:, 7::4] > 125).all(1)
    away = (degrees[:, 0] > -12) & (degrees[:, 1] < 22) & (degrees[:, 3] < 18)
    return curled & away & (degrees[:, 4] < 25)


def upright_thumbs(n: int, dice: Dice) -> Tensor:
    """(n, 3, 3) hands whose thumb's side is up in the image, seen from anywhere around them."""
    around = turn(dice.uniform(n, low=-math.pi, high=math.pi), 1)
    leaning = turn(0.35 * dice.normal(n), 2) @ turn(0.35 * dice.normal(n), 0)
    return leaning @ around @ turn(torch.full((n,), -0.5 * math.pi), 2)


def turn(angle: Tensor, axis: int) -> Tensor:
    """(N, 3, 3) rotations by angles (N,) about the x, y or z axis, 0 to 2."""
    vector = torch.zeros(len(angle), 3)
    vector[:, axis] = angle
    return roma.rotvec_to_rotmat(vector)


def posed_hands(
    bank: ShapeBank,
    pivot_m: Tensor,
    left: Tensor,
    dice: Dice,
    label: int,
    rotation: Tensor | None = None,
    angles: Tensor | None = None,
    views: Tensor | None = None,
    known: Tensor | None = None,
) -> Hands:
    """Random hands about given middles of the palm (N, 3); `left` (N,) are mirror images.

    rotation, angles: (N, 3, 3), (N, 21), where they are known; hands of known angles hold nothing.
    known: (N,) which of those given are; None = all of them.
    """
    n = len(pivot_m)
    rows = dice.rows(len(bank.log_size), n)
    shape, surface = bank.rows(rows)
    size = bank.log_size[rows].exp()
    parts = torch.zeros(n, 0, PART)
    free = torch.full((n,), angles is None) if known is None else ~known
    if angles is None or known is not None:
        own = shown_poses(n, dice)
        angles = own if angles is None else torch.where(free[:, None], own, angles)
    shape, surface = cupped(shape, surface, angles, bank.log_size[rows], dice)
    if bool(free.any()):
        some = (free & dice.chance(HOLDING, n)).nonzero()[:, 0]
        angles, parts = angles.clone(), torch.zeros(n, PARTS_OF_A_THING, PART)
        parts[..., 0] = -1
        if len(some) > 0:
            holding = rows_of(shape, surface, some)
            angles[some], parts[some] = random_grasps(*holding, size[some], dice)
    if rotation is None or known is not None:
        raised = thumb_is_up(angles) & dice.chance(UPRIGHT_THUMBS, n)
        turned = random_rotations(n, dice, views)
        turned = torch.where(raised[:, None, None], upright_thumbs(n, dice), turned)
        rotation = (
            turned if rotation is None else torch.where(free[:, None, None], turned, rotation)
        )
    state = torch.zeros(n, 27)
    state[:, 3:6] = roma.rotmat_to_rotvec(rotation)
    state[:, 6:] = angles
    pose = forward_kinematics(state, shape)
    ellipsoids = surface.pose(pose)
    elbow, arm_centres, arm_axes, arm_labels, bare = _forearms(rotation, size, label, dice)
    centres = torch.cat((ellipsoids.centres_m[:, :-1], arm_centres), 1)
    axes = torch.cat((ellipsoids.axes_m[:, :-1], arm_axes), 1)
    hand_labels = torch.full((n, centres.shape[1] - arm_labels.shape[1]), label)
    labels = torch.cat((hand_labels, arm_labels), 1)
    bare = torch.cat((torch.ones_like(hand_labels, dtype=torch.bool), bare), 1)

    # Everything is about the wrist so far. A left hand is the mirror image of the whole.
    pivot = (rotation @ torch.tensor(PIVOT_M)) * size[:, None]
    mirror = torch.where(left[:, None], torch.tensor([-1.0, 1.0, 1.0]), torch.ones(3))
    shift = pivot_m - pivot * mirror
    joints = pose.joints_m * mirror[:, None] + shift[:, None]
    centres = centres * mirror[:, None] + shift[:, None]
    axes = axes * mirror[:, None, :, None]
    return Hands(
        pivot_m=pivot_m,
        rotation=rotation,
        angles=angles,
        log_size=bank.log_size[rows],
        left=left,
        joints_m=joints,
        elbow_m=elbow * mirror + shift,
        centres_m=centres,
        axes_m=axes,
        labels=labels,
        skins=random_skins(centres, axes, joints, bare, dice),
        parts=_carried(parts, rotation, mirror, shift),
    )


def _carried(parts: Tensor, rotation: Tensor, mirror: Tensor, shift: Tensor) -> Tensor:
    """Parts of things (N, Q, PART) out of the frames of hands."""
    place = (parts[..., 1:4] @ rotation.mT) * mirror[:, None] + shift[:, None]
    rows = parts[..., 4:13].unflatten(2, (3, 3)) @ rotation.mT[:, None]
    rows = (rows * mirror[:, None, None]).flatten(2)
    return torch.cat((parts[..., :1], place, rows, parts[..., 13:]), 2)


def _forearms(
    rotation: Tensor, size: Tensor, label: int, dice: Dice
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Elbows, and the forearms' ellipsoids, about the wrist: bent, bare or in sleeves, or none.

    Returns (N, 3), (N, A, 3), (N, A, 3, 3), labels (N, A) and (N, A) what no sleeve covers.
    """
    n = len(size)
    flexion = (0.4 * dice.normal(n)).clamp(-1.1, 1.1)
    deviation = (0.2 * dice.normal(n)).clamp(-0.6, 0.5)
    bent = rotation @ turn(flexion, 0) @ turn(deviation, 2)
    along = bent[:, :, 1]
    length = _FOREARM_M * size * (1 + 0.08 * dice.normal(n))
    sleeve = torch.where(dice.chance(0.35, n), dice.uniform(n, low=1.1, high=1.7), 1.0)
    start = torch.where(sleeve > 1, dice.uniform(n, high=0.25), 0.0)
    cuffed = (sleeve > 1) & dice.chance(0.3, n)
    start = torch.where(cuffed, 0.0, start)
    breadth, depth = 0.027 + 0.004 * dice.normal(n), 0.020 + 0.003 * dice.normal(n)
    part = torch.linspace(0, 1, _ALONG)
    centres = along[:, None] * (length[:, None] * part)[..., None]
    grown = size[:, None] * (1 + 0.55 * part * (1.3 - part))
    grown = grown * torch.where(part >= start[:, None], sleeve[:, None], 1.0)
    half = (0.75 * length / (_ALONG - 1))[:, None].expand_as(grown)
    scales = torch.stack((breadth[:, None] * grown, half * 1.1, depth[:, None] * grown), -1)
    axes = bent[:, None] * scales[..., None, :]
    # A cuff reaches over the hand, to the knuckles at most.
    reach = dice.uniform(n, high=0.045) * size
    cuff = rotation @ torch.tensor([0.0, -1.0, -0.1]) * reach[:, None]
    wide = dice.uniform(n, low=0.040, high=0.052)
    thick = dice.uniform(n, low=0.022, high=0.034)
    over = torch.stack((wide, torch.full((n,), 0.045), thick), 1) * size[:, None]
    centres = torch.cat((centres, cuff[:, None]), 1)
    axes = torch.cat((axes, (rotation * over[:, None])[:, None]), 1)
    # Without an arm (cut off by a dark sleeve, say) only the first piece is left, or not even that.
    kept = torch.where(dice.chance(0.08, n), dice.rows(2, n), _ALONG)
    arm = FOREARM if label == HAND else OTHER_FOREARM
    labels = torch.where(torch.arange(_ALONG) < kept[:, None], arm, -1)
    labels = torch.cat((labels, torch.where(cuffed & (kept == _ALONG), arm, -1)[:, None]), 1)
    bare = (sleeve[:, None] <= 1) | (part < start[:, None])
    bare = torch.cat((bare, torch.zeros(n, 1, dtype=torch.bool)), 1)
    return along * length[:, None], centres, axes, labels, bare


POWER_SHARE = 0.52
"""Of all grasps; the others are precision grasps."""
_OPENED_SHARE = 0.12
"""Grasps that are just being opened or closed."""
_THUMB_TRIES = 10
"""Places from which a thumb tries to reach what is held in the palm."""
_OPPOSED_SHARE = 0.5
"""Thumbs that face the palm across what is held in it, if they can."""
_DEEPEST_M = 0.004


def random_grasps(
    shape: HandShape, surface: HandSurface, size: Tensor, dice: Dice
) -> tuple[Tensor, Tensor]:
    """A grasp for each of N right hands, see ShapeBank.rows: the poses (N, 21), and the things that
    the fingers touch (N, Q, PART), in the frames of the hands; where that failed there is none.

    size: (N,) in mean adult's hands.
    """
    n = len(size)
    power = dice.chance(POWER_SHARE, n)
    radii, shifts = _capsules(surface)
    bare = shown_poses(n, dice)
    palm_angles, palm_parts = things_in_palms(size, dice)
    thumbs = open_thumbs(n, _THUMB_TRIES, dice)
    opposed = dice.chance(_OPPOSED_SHARE, n)
    tip_angles, tip_parts, closing = things_between_tips(shape, radii, shifts, bare, dice)
    angles = torch.where(power[:, None], palm_angles, tip_angles)
    parts = torch.where(power[:, None, None], palm_parts, tip_parts)
    said = torch.zeros(n, 2, dtype=torch.float64)
    most = torch.tensor([35, 45, 15, 55, 60] + [0, 82, 100, 55] * 4) + 6.0 * dice.normal(n, 21)
    most = clamp_to_joint_limits(torch.deg2rad(most)).double()
    angles, parts = angles.double().contiguous(), parts.double().contiguous()
    flesh = ((0.013 + 0.0015 * dice.normal(n)) * size).double()
    bones = (shape.base_frames, shape.base_m, shape.bone_lengths_m, radii, shifts)
    grasp(
        angles.numpy(),
        _doubles(thumbs),
        opposed.numpy(),
        most.numpy(),
        (power | closing).numpy(),
        power.numpy(),
        flesh.numpy(),
        tuple(map(_doubles, bones)),
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
    return clamp_to_joint_limits(angles), parts


def _doubles(tensor: Tensor):
    return tensor.double().contiguous().numpy()


def _capsules(surface: HandSurface) -> tuple[Tensor, Tensor]:
    """(N, 5, 3) radii of the bones' capsules, and how far palmward of the bones they lie."""
    bones = torch.tensor([4 * f + b for f in range(5) for b in range(3)])
    size = surface.axes_m[:, bones].norm(dim=2)
    radii = 0.48 * (size[..., 0] + size[..., 2])
    return radii.unflatten(1, (5, 3)), -surface.centres_m[:, bones, 2].unflatten(1, (5, 3))
