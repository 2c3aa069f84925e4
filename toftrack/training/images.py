"""Training images on the fly: crops for the pose network, whole images for the finder."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from toftrack.detector.crops import CROP, CROP_M, WIDE_F_PX, wide
from toftrack.detector.network import SEGMENTS, STRIDE
from toftrack.pose_space.base import clamp_to_joint_limits
from toftrack.training.dice import Dice
from toftrack.training.furniture import before_camera, furniture, on_a_piece
from toftrack.training.hands import (
    BACKGROUND,
    FOREARM,
    FRONT,
    HAND,
    OTHER_FOREARM,
    OTHER_HAND,
    THING,
    Hands,
    posed_hands,
    random_views,
    turn,
)
from toftrack.training.pictures import Lens, random_sensors, read_pictures, take_pictures
from toftrack.training.scenes import (
    Scenes,
    background_behind,
    moved,
    surroundings,
    tables_under,
    things,
)
from toftrack.training.shapes import ShapeBank

_SAMPLES = 2 * CROP
_WHOLE = math.ceil(_SAMPLES * 2**0.5) + 1
"""Pixels of a picture of which a turned crop is read."""
NEW_HANDS = 0.25
"""How many crops are as of new hands: as the camera is held, and less well centred."""
_LEFT = 0.1
"""How many hands are left ones: the network learns that and where they are, but not their poses."""
_WRONG = 0.25
"""How many hands that are followed are followed with a wrong pose, so that the crop is off."""
_CENTRE_M = 0.009, 0.030
"""By how much the middle of a crop of a hand that is followed is off along each axis: where its
pose is right, and where it is wrong. Of right poses of recordings 90 % are off by less than 12 mm,
all axes together."""
_NEW_CENTRE_M = 0.014, 0.036
"""The same of new hands, half of which the finder placed well."""
_DIRECTION = 0.15, 0.8
"""By how much it is uncertain where the fingers of a hand point that is followed, of 1 m: where its
pose is right, and where it is wrong, which turns crops by half a right angle."""
WIDE_SIZE = (80, 96)
"""Rows and columns of the finder's training images."""
_WIDE_K = np.diag((WIDE_F_PX, WIDE_F_PX, 1.0))
"""Of which every pixel is read; no matter where the centre is."""
_ELSEWHERE = 0.30
"""Crops about something else than a hand."""
_EMPTY = 0.25
"""Whole images without a raised hand."""
FURNISHED = 0.3, 0.8
"""Images with a hand, and those without one, that show furniture."""
_FURNISHED_CROPS = 0.6, 0.12
"""Crops about something else, and crops of hands, that show furniture."""
_CUT = 0.45, 0.25
"""Those that are cut by a border of the image."""
_MIDDLE = 0.6
"""Whole images whose hand is near the middle; of the others it is anywhere, also at the border."""
_OTHERS = 0.30, 0.25
"""Crops of hands, and crops about something else, with a second hand."""
_TOUCHING = 0.4
"""How many second hands are beside the first and touch it, before or behind it."""
_TWINS = 0.6
"""How many of those show its mirror image."""
HAND_M2 = 0.0105
"""About what a mean adult's hand covers from most sides."""


class Crops(NamedTuple):
    """N crops, and their hands in the crop's frame about its centre.

    image: (N, CROP_CHANNELS, CROP, CROP).
    parts: (N, PARTS, PARTS) of SEGMENTS, -1 = not in the image.
    present: (N,) a hand is seen near the centre.  right: (N,) it is, or would be, a right one.
    pivot_m: (N, 3).  rotation: (N, 3, 3).  angles: (N, 21).  log_size: (N,).
    joints_m: (N, 21, 3).
    """

    image: Tensor
    parts: Tensor
    present: Tensor
    right: Tensor
    pivot_m: Tensor
    rotation: Tensor
    angles: Tensor
    log_size: Tensor
    joints_m: Tensor


class WideImages(NamedTuple):
    """Whole images and the hands in them: the first is raised, the second another's.

    image: (N, 2, *WIDE_SIZE).  cell: (N, 2, 2) column and row of the middle of the palm in cells.
    depth_m: (N, 2) its Z.  seen: (N, 2) which part of the hand is in view, 0 = none.
    """

    image: Tensor
    cell: Tensor
    depth_m: Tensor
    seen: Tensor


def crop_images(n: int, bank: ShapeBank, generator: torch.Generator) -> Crops:
    """n crops: most about a hand's middle, more or less; some about something else."""
    dice = Dice(generator)
    distance = dice.uniform(n, low=math.log(0.27), high=math.log(1.1)).exp()
    centre = torch.stack((torch.zeros(n), torch.zeros(n), distance), 1)
    known = ~dice.chance(NEW_HANDS, n)
    off = dice.chance(torch.where(known, _WRONG, 0.5), n)
    spread = torch.tensor((_NEW_CENTRE_M, _CENTRE_M))[known.int(), off.int()]
    near = spread[:, None] * dice.normal(n, 3)
    away = torch.nn.functional.normalize(dice.normal(n, 3), dim=1)
    away = away * dice.uniform(n, 1, low=0.13, high=0.30)
    present = ~dice.chance(_ELSEWHERE, n)
    pivot = centre + torch.where(present[:, None], near.clamp(-0.09, 0.09), away)
    left = dice.chance(_LEFT, n)
    views = random_views(n, dice)
    hands = posed_hands(bank, pivot, left, dice, HAND, views=views)
    # Most of the crops about something else: there is no hand at all, only its arm, or nothing.
    gone = ~present & dice.chance(0.75, n)
    labels = _without(HAND, gone, hands.labels)
    other = other_hands(hands, bank, dice, touching=present)
    there = dice.chance(torch.where(present, *_OTHERS), n)
    scenes = random_scenes(hands, labels, (other, there), dice, objects=0.12, views=views)
    # What a hand held is as likely to lie there alone.
    alone = gone & (hands.parts[..., 0] >= 0).any(1) & dice.chance(0.6, n)
    onto = _onto_something(scenes, centre, dice)
    onto_thing = centre + 0.02 * dice.normal(n, 3) - hands.parts[:, 0, 1:4]
    onto = torch.where(alone[:, None], onto_thing, onto)
    scenes = moved(scenes, torch.where(gone[:, None], onto, 0.0))
    scenes = _with_furniture(scenes, centre, gone & ~alone, dice)

    turned = torch.where(known, _upright_angles(hands, off, dice), 0.0)
    pixels = (CROP_M / distance) * dice.uniform(n, low=math.log(110.0), high=math.log(600.0)).exp()
    side = pixels.round().clamp(36, _SAMPLES)
    whole = (side * (turned.cos().abs() + turned.sin().abs())).ceil()
    middle = (whole - 1) / 2
    lens = Lens(side * distance / CROP_M, middle, middle, whole, whole)
    depth, which = take_pictures(scenes, lens, random_sensors(n, dice), (_WHOLE, _WHOLE), dice)
    sides = torch.stack((whole, side), 1).int()
    borders = _borders(torch.where(gone, *_CUT), dice)
    image, parts = read_pictures(depth, which, sides, distance, turned, borders)
    parts = torch.where(parts == OTHER_HAND, OTHER_FOREARM, parts)
    parts = torch.where(parts == THING, SEGMENTS - 1, parts)
    back = turn(turned, 2)  # from the crop's frame
    return Crops(
        image=image,
        parts=parts,
        present=present & ((parts == HAND).sum((1, 2)) >= 12),
        right=~left,
        pivot_m=((pivot - centre)[:, None] @ back)[:, 0],
        rotation=back.mT @ hands.rotation,
        angles=hands.angles,
        log_size=hands.log_size,
        joints_m=(hands.joints_m - centre[:, None]) @ back,
    )


def _without(label: int, gone: Tensor, labels: Tensor) -> Tensor:
    """Labels (N, E), without those of one kind where it is gone (N,)."""
    return torch.where(gone[:, None] & (labels == label), -1, labels)


def _upright_angles(hands: Hands, wrong: Tensor, dice: Dice) -> Tensor:
    """(N,) turns of crops in which the fingers point up, as far as a tracker knows where they do:
    well where they lie across, hardly where they point at the camera or away, or where its pose is
    wrong (N,).
    """
    up = hands.joints_m[:, 9] - hands.joints_m[:, 0]
    uncertain = torch.where(wrong, _DIRECTION[1], _DIRECTION[0])[:, None]
    up = torch.nn.functional.normalize(up, dim=1) + uncertain * dice.normal(len(up), 3)
    return torch.atan2(up[:, 0], -up[:, 1])


def _onto_something(scenes: Scenes, centre_m: Tensor, dice: Dice) -> Tensor:
    """(N, 3) by how much to move scenes so that the crop shows some thing or part of a body."""
    drawn = (scenes.labels == BACKGROUND) | (scenes.labels == FOREARM) | (scenes.labels == THING)
    weights = drawn.float() + 1e-6
    one = torch.multinomial(weights, 1, generator=dice.generator)[:, 0]
    at = scenes.centres_m[torch.arange(len(one)), one]
    thick = scenes.axes_m[torch.arange(len(one)), one][:, 2].norm(dim=1)
    near = at + 0.03 * dice.normal(len(one), 3)
    near[:, 2] -= 0.8 * thick
    return centre_m - near


def wide_images(n: int, bank: ShapeBank, generator: torch.Generator) -> WideImages:
    """n whole images, a quarter of them without a raised hand."""
    dice = Dice(generator)
    height, width = WIDE_SIZE
    columns = dice.uniform(n, low=60, high=width).round()
    rows = (columns * dice.uniform(n, low=0.70, high=0.95)).round().clamp(max=height)
    lens = Lens(
        torch.full((n,), WIDE_F_PX),
        (columns - 1) / 2 + 2.0 * dice.normal(n),
        (rows - 1) / 2 + 2.0 * dice.normal(n),
        columns,
        rows,
    )
    z = dice.uniform(n, low=math.log(0.25), high=math.log(1.15)).exp()
    anywhere = dice.uniform(n, 2, low=-0.05, high=1.05)
    at = torch.where(dice.chance(_MIDDLE, n, 1), 0.5 + 0.2 * dice.normal(n, 2), anywhere)
    u, v = columns * at[:, 0], rows * at[:, 1]
    pivot = torch.stack(((u - lens.cx) / WIDE_F_PX * z, (v - lens.cy) / WIDE_F_PX * z, z), 1)
    left = dice.chance(0.5, n)
    views = random_views(n, dice)
    hands = posed_hands(bank, pivot, left, dice, HAND, views=views)
    raised = ~dice.chance(_EMPTY, n)
    labels = _without(HAND, ~raised, hands.labels)
    # Without its hand, mostly no forearm is held up either.
    labels = _without(FOREARM, ~raised & dice.chance(0.7, n), labels)
    other = other_hands(hands, bank, dice, touching=raised)
    there = dice.chance(0.35, n) & raised
    scenes = random_scenes(hands, labels, (other, there), dice, objects=0.15, views=views)
    scenes = furnished(scenes, dice.chance(torch.where(raised, *FURNISHED), n), dice)
    taken, which = take_pictures(scenes, lens, random_sensors(n, dice), WIDE_SIZE, dice)
    depth = poorly_read(torch.from_numpy(taken), lens, dice)

    cells, seen = [], []
    shown = torch.from_numpy(which)
    for one, label, exists in ((hands, HAND, raised), (other, OTHER_HAND, there)):
        at = one.pivot_m[:, :2] / one.pivot_m[:, 2:] * WIDE_F_PX
        at = at + torch.stack((lens.cx, lens.cy), 1)
        cells.append((at + 0.5) / STRIDE - 0.5)
        expected = HAND_M2 * (2 * one.log_size).exp() * (WIDE_F_PX / one.pivot_m[:, 2]) ** 2
        part = ((shown == label) & (depth > 0)).sum((1, 2)) / expected
        seen.append(torch.where(exists, part, torch.zeros(n)))
    return WideImages(
        image=torch.cat([wide(one, _WIDE_K)[0] for one in depth.numpy()]),
        cell=torch.stack(cells, 1),
        depth_m=torch.stack((hands.pivot_m[:, 2], other.pivot_m[:, 2]), 1),
        seen=torch.stack(seen, 1),
    )


def _with_furniture(scenes: Scenes, centre_m: Tensor, gone: Tensor, dice: Dice) -> Scenes:
    """Crops' scenes, many of those without a hand with a piece of furniture in their middle, and
    some of the others with furniture behind or beside the hand.
    """
    n = len(gone)
    there = dice.chance(torch.where(gone, *_FURNISHED_CROPS), n)
    aside = 0.2 * dice.normal(n, 2)
    behind = dice.uniform(n, 1, low=0.0, high=0.5)
    pieces = furniture(there, centre_m + torch.cat((aside, behind), 1), dice)
    onto = centre_m + 0.02 * dice.normal(n, 3) - on_a_piece(pieces, dice)
    pieces[..., 1:4] += torch.where((gone & there)[:, None, None], onto[:, None], 0.0)
    return _with_pieces(scenes, pieces, gone & there & dice.chance(0.7, n))


def furnished(scenes: Scenes, there: Tensor, dice: Dice) -> Scenes:
    """Scenes with furniture, and mostly without walls before it; there: (N,) where there is any."""
    without_walls = there & dice.chance(0.7, len(there))
    pieces = furniture(there, before_camera(len(there), dice), dice)
    return _with_pieces(scenes, pieces, without_walls)


def _with_pieces(scenes: Scenes, pieces: Tensor, without_walls: Tensor) -> Scenes:
    planes = scenes.planes.clone()
    planes[..., 3] = torch.where(without_walls[:, None], torch.inf, planes[..., 3])
    return replace(scenes, planes=planes, parts=torch.cat((scenes.parts, pieces), 1))


def poorly_read(depth_m: Tensor, lens: Lens, dice: Dice) -> Tensor:
    """Images (N, H, W) as some cameras take them: of what is far few pixels are read, and some
    where there is nothing.
    """
    n, height, width = depth_m.shape
    begins = torch.where(dice.chance(0.3, n), dice.uniform(n, low=0.5, high=1.5), 9.0)
    falls = dice.uniform(n, low=0.1, high=0.8)
    missed = ((depth_m - begins[:, None, None]) / falls[:, None, None]).clamp(max=0.97)
    depth_m = torch.where(dice.uniform(n, height, width) < missed, 0.0, depth_m)
    share = torch.where(dice.chance(0.3, n), dice.uniform(n, high=0.03), 0.0)
    stray = (dice.uniform(n, height, width) < share[:, None, None]) & (depth_m == 0)
    stray &= torch.arange(height)[:, None] < lens.height[:, None, None]
    stray &= torch.arange(width) < lens.width[:, None, None]
    return torch.where(stray, dice.uniform(n, height, width, low=0.05, high=1.5), depth_m)


def other_hands(hands: Hands, bank: ShapeBank, dice: Dice, touching: Tensor) -> Hands:
    """Second hands of either side: 7 to 40 cm away from the first ones, or touching them.

    touching: (N,) which may touch. Many of these are mirror images of the first ones, as people
    hold up both hands.
    """
    n = len(hands.pivot_m)
    away = torch.nn.functional.normalize(dice.normal(n, 3), dim=1)
    away = away * dice.uniform(n, 1, low=0.11, high=0.40)
    away[:, 2] *= 0.6
    touching = touching & dice.chance(_TOUCHING, n)
    twins = touching & dice.chance(_TWINS, n)
    direction = math.pi * dice.rows(2, n) + 0.4 * dice.normal(n)
    beside = dice.uniform(n, low=0.05, high=0.14)
    nearer = torch.where(dice.chance(0.5, n), 1.0, -1.0) * dice.uniform(n, high=0.07)
    nearer = torch.where(beside < 0.08, 0.03 * nearer.sign() + 0.6 * nearer, nearer)
    close = torch.stack((beside * direction.cos(), beside * direction.sin(), nearer), 1)
    pivot = hands.pivot_m + torch.where(touching[:, None], close, away)
    pivot[:, 2] = pivot[:, 2].clamp(min=0.22)
    left = torch.where(twins, ~hands.left, dice.chance(0.5, n))
    alike = hands.rotation @ turn(0.25 * dice.normal(n), 2) @ turn(0.25 * dice.normal(n), 1)
    angles = clamp_to_joint_limits(hands.angles + 0.1 * dice.normal(n, 21))
    return posed_hands(bank, pivot, left, dice, OTHER_HAND, alike, angles, known=twins)


def random_scenes(
    hands: Hands,
    labels: Tensor,
    other: tuple[Hands, Tensor],
    dice: Dice,
    objects: float,
    views: Tensor,
) -> Scenes:
    """Everything around a batch of hands.

    labels: (N, E) of the hands' ellipsoids.  other: second hands, and where there are any (N,).
    objects: probability of each of two things before or behind a hand.
    views: (N,) where the cameras are.
    """
    n = len(labels)
    second, there = other
    body = surroundings(hands, dice, views)
    stuff = things(hands.pivot_m, 2, objects, dice)
    other_labels = torch.where(there[:, None], second.labels, -1)
    centres = (hands.centres_m, second.centres_m, body[0], stuff[0])
    axes = (hands.axes_m, second.axes_m, body[1], stuff[1])
    planes = background_behind((hands.pivot_m[:, 2] + 0.1).clamp(min=0.4), dice)
    # Whoever looks down sees a table, or the floor far below.
    planes[..., 3] = torch.where((views == FRONT)[:, None], planes[..., 3], torch.inf)
    planes = torch.cat((planes, tables_under(hands, views, dice)), 1)
    all_labels = torch.cat((labels, other_labels, body[2], stuff[2]), 1)
    covered = torch.cat((hands.skins.covered, second.skins.covered), 1)
    plain = torch.zeros(n, all_labels.shape[1] - covered.shape[1], dtype=torch.bool)
    parts = second.parts.clone()
    parts[..., 0] = torch.where(there[:, None], parts[..., 0], -1.0)
    skins = hands.skins, second.skins
    return Scenes(
        torch.cat(centres, 1),
        torch.cat(axes, 1),
        all_labels,
        planes,
        torch.cat((covered, plain), 1),
        torch.stack([skin.primitives for skin in skins], 1),
        torch.stack((skins[0].labels(labels), skins[1].labels(other_labels)), 1),
        torch.stack([skin.widths_m for skin in skins], 1),
        torch.cat((hands.parts, parts), 1),
    )


def _borders(p: Tensor, dice: Dice) -> Tensor:
    """(N, 2, 3) what lies in the image: a x + b y < c for x, y in -0.5 .. 0.5 across the crop.

    Crops are cut by a border of the image with probabilities p (N,), some of them in a corner, and
    are turned a little against the image.
    """
    n = len(p)
    which = dice.uniform(n)
    c = dice.uniform(n, 2, low=-0.2, high=0.45)
    angle = 0.5 * math.pi * dice.rows(4, n)[:, None] + 0.12 * dice.normal(n, 1)
    angle = angle + torch.tensor([0.0, 0.5 * math.pi])
    cut = which[:, None] < p[:, None] * torch.tensor([1.0, 0.16])
    return torch.stack((angle.cos(), angle.sin(), torch.where(cut, c, 9.0)), 2)
