"""The things that hands hold in training images, and the hands before they close on them.

In the palm, a thing's axis lies across it; between the tips of thumb and index finger, the thing is
what fits into the room between them. Phones and hammers are left out, see hands.py.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, forward_kinematics
from toftrack.pose_space.base import clamp_to_joint_limits
from toftrack.training.dice import Dice
from toftrack.training.things_numba import BALL, BOX, CONE, RING

IN_PALM = {
    "cylinder": 0.24,
    "cup": 0.14,
    "mug": 0.10,
    "bottle": 0.10,
    "ball": 0.14,
    "box": 0.14,
    "tool": 0.14,
    "odd": 0.18,
}
"""How often each thing is held in the palm, in parts of their sum, of the power grasps; a tool is a
handle and a shaft, an odd thing a handle of any shape and another part that stands off it."""
BETWEEN_TIPS = {
    "plate": (0.75, 0.20, 0.10, 0.05),
    "disc": (0.25, 0.15, 0.10, 0.10),
    "pen": (0.0, 0.45, 0.05, 0.0),
    "cube": (0.0, 0.10, 0.25, 0.20),
    "ball": (0.0, 0.05, 0.20, 0.25),
    "cylinder": (0.0, 0.05, 0.30, 0.20),
    "cup": (0.0, 0.0, 0.0, 0.20),
}
"""How often each thing is held between tips that leave room of up to 5, 15 and 30 mm, and more."""
PARTS_OF_A_THING = 2
_OPPOSED_SHARE = 0.65
"""Hands about to close on a thing in the palm whose thumb stands before the palm."""
_PHONE_M = ((0.055, 0.095), (0.115, 0.185), (0.0, 0.016))
"""Width, length and thickness of what could be a phone."""


def make_part(
    kind: int,
    place: Tensor,
    rows: Tensor,
    sizes: Tensor | tuple[Tensor, Tensor, Tensor],
    edge: Tensor | None = None,
    wall: Tensor | None = None,
) -> Tensor:
    """(N, PART); place: (N, 3), rows: (N, 3, 3), sizes: (N, 3) or its columns, edge, wall: (N,),
    None = 0.
    """
    sizes = sizes if isinstance(sizes, Tensor) else torch.stack(sizes, 1)
    none = torch.zeros(len(place))
    x, y, z = sizes.unbind(1)
    reach = {
        BOX: sizes.norm(dim=1),
        CONE: torch.hypot(torch.maximum(x, y), z),
        RING: x + y,
        BALL: x,
    }[kind]
    rest = (none if edge is None else edge, none if wall is None else wall, reach + 0.001)
    head = torch.full((len(place), 1), float(kind))
    return torch.cat((head, place, rows.flatten(1), sizes, torch.stack(rest, 1)), 1)


def _thing(*parts: Tensor) -> Tensor:
    """(N, PARTS_OF_A_THING, PART), filled up with none."""
    none = torch.zeros_like(parts[0])
    none[:, 0] = -1
    return torch.stack((*parts, none)[:PARTS_OF_A_THING], 1)


def _chosen(things: list[Tensor], which: Tensor) -> Tensor:
    return torch.stack(things)[which, torch.arange(len(which))]


def things_in_palms(size: Tensor, dice: Dice) -> tuple[Tensor, Tensor]:
    """Open hands (N, 21), and things (N, Q, PART) whose axis y lies across the palm."""
    n = len(size)

    def between(low: float, high: float) -> Tensor:
        return dice.uniform(n, low=low, high=high)

    zero = torch.zeros(n)
    oblique = torch.deg2rad(18.0 * dice.normal(n) + 8.0)
    lean = 0.15 * dice.normal(n)
    way = torch.where(dice.chance(0.5, n), 1.0, -1.0)[:, None]
    y = way * torch.stack((oblique.cos(), oblique.sin(), lean), 1)
    y = torch.nn.functional.normalize(y, dim=1)
    z = torch.linalg.cross(y, torch.nn.functional.normalize(dice.normal(n, 3), dim=1))
    z = torch.nn.functional.normalize(z, dim=1)
    rows = torch.stack((torch.linalg.cross(y, z), y, z), 1)
    place = torch.stack((between(-0.010, 0.008), between(-0.112, -0.062), zero), 1) * size[:, None]
    along = between(-0.6, 0.6)

    def at(half: Tensor, offset: Tensor | None = None) -> Tensor:
        off = along * (half - 0.03).clamp(min=0) if offset is None else offset
        return place + y * off[:, None]

    edge = between(0.0, 0.004)
    radius, half = between(0.008, 0.042), between(0.035, 0.13)
    taper = 1 + 0.08 * dice.normal(n)
    cylinder = make_part(CONE, at(half), rows, (radius, radius * taper, half), edge)
    low, high, tall = between(0.022, 0.038), between(1.0, 1.35), between(0.035, 0.07)
    wall, middle = between(0.0015, 0.004), at(tall, 0.3 * along * tall)
    cup = make_part(CONE, middle, rows, (low, low * high, tall), wall=wall)
    ring, thick = between(0.016, 0.028), between(0.0035, 0.007)
    beside = torch.where(dice.chance(0.5, n), 1.0, -1.0)[:, None] * rows[:, 0]
    beside = beside * (0.5 * low * (1 + high) + 0.6 * ring)[:, None]
    handle_rows = torch.stack((y, rows[:, 0], rows[:, 2]), 1)
    handle = make_part(RING, middle + beside, handle_rows, (ring, thick, thick))
    body, neck = between(0.022, 0.040), between(0.25, 0.5)
    tall_2, neck_long = between(0.05, 0.10), between(0.02, 0.05)
    bottle = make_part(CONE, at(tall_2), rows, (body, body, tall_2), 0.3 * body)
    neck_place = at(tall_2) + y * (tall_2 + 0.8 * neck_long)[:, None]
    neck_part = make_part(CONE, neck_place, rows, (body * neck * 1.3, body * neck, neck_long))
    ball_radius = between(0.014, 0.045)
    ball = make_part(BALL, at(ball_radius, zero), rows, ball_radius[:, None].expand(n, 3))
    box_sizes = torch.stack((between(0.010, 0.035), between(0.03, 0.10), between(0.008, 0.035)), 1)
    box = make_part(BOX, at(box_sizes[:, 1]), rows, _no_phone(box_sizes), edge)
    grip, grip_long = between(0.008, 0.017), between(0.045, 0.07)
    grip_place = at(grip_long, 0 * along)
    handle_2 = make_part(CONE, grip_place, rows, (grip, grip, grip_long), edge)
    shaft_long = between(0.03, 0.09)
    shaft_place = grip_place + y * (grip_long + shaft_long)[:, None]
    blade = torch.stack((between(0.006, 0.03), shaft_long, between(0.0012, 0.003)), 1)
    rod = (between(0.002, 0.006), between(0.002, 0.006), shaft_long)
    tool = torch.where(
        dice.chance(0.5, n)[:, None],
        make_part(BOX, shaft_place, rows, _no_phone(blade)),
        make_part(CONE, shaft_place, rows, rod),
    )
    # None is as thin as a hammer's handle.
    oval = torch.stack((between(0.02, 0.042), between(0.02, 0.042), between(0.02, 0.09)), 1)
    block = torch.stack((between(0.02, 0.035), between(0.03, 0.10), between(0.02, 0.035)), 1)
    grips = [
        make_part(CONE, at(oval[:, 2]), rows, oval, 0.3 * oval[:, :2].amin(1)),
        make_part(BOX, at(block[:, 1]), rows, block, edge),
    ]
    off = torch.nn.functional.normalize(dice.normal(n, 3), dim=1)
    # Beyond the hand's width along the axis, or before the palm.
    off = off * torch.tensor([0.03, 0.03, 0.0]) + y * (along.sign() * between(0.04, 0.11))[:, None]
    off[:, 2] -= between(0.0, 0.06)
    turned = dice.rotations(n)
    lump = torch.stack((between(0.005, 0.05), between(0.005, 0.06), between(0.003, 0.05)), 1)
    lumps = [
        make_part(BOX, place + off, turned, _no_phone(lump), 0.2 * lump.amin(1)),
        make_part(CONE, place + off, turned, lump, 0.2 * lump.amin(1)),
        make_part(BALL, place + off, turned, lump[:, :1].expand(n, 3)),
        make_part(RING, place + off, turned, 0.5 * lump + 0.005),
    ]
    odd = _chosen(grips, dice.rows(len(grips), n)), _chosen(lumps, dice.rows(len(lumps), n))
    things = {
        "cylinder": _thing(cylinder),
        "cup": _thing(cup),
        "mug": _thing(cup, handle),
        "bottle": _thing(bottle, neck_part),
        "ball": _thing(ball),
        "box": _thing(box),
        "tool": _thing(handle_2, tool),
        "odd": _thing(*odd),
    }
    weights = torch.tensor(list(IN_PALM.values()))
    which = torch.multinomial(weights, n, True, generator=dice.generator)
    # Open, the fingers a little bent.
    fingers = torch.tensor([0.0, -8.0, 14.0, 8.0])
    fingers = fingers + torch.tensor([5.0, 5.0, 9.0, 5.0]) * dice.normal(n, 4, 4)
    spread = torch.tensor([12.0, 2.0, -8.0, -16.0]) * dice.uniform(n, 1, low=-1.8, high=0.8)
    fingers[..., 0] += spread
    angles = torch.cat((torch.zeros(n, 5), fingers.flatten(1)), 1)
    held = _chosen([things[name] for name in IN_PALM], which)
    return clamp_to_joint_limits(torch.deg2rad(angles)), held


def open_thumbs(n: int, tries: int, dice: Dice) -> Tensor:
    """(N, tries, 5) thumbs about to close on a thing in the palm: before it or beside it."""
    many = (n, tries)

    def between(low: float, high: float) -> Tensor:
        return dice.uniform(*many, low=low, high=high)

    beside = torch.tensor([10.0, -12.0, 0.0, -5.0, 0.0])
    beside = beside + torch.tensor([14.0, 8.0, 8.0, 5.0, 8.0]) * dice.normal(*many, 5)
    # Mostly it is opposed: about what is thick it only reaches when it is held away from the palm.
    wide = 45 - 40 * between(0, 1).square()
    opposed = torch.stack((wide, between(-5, 50), between(-25, 8)), -1)
    ends = torch.tensor([5.0, 8.0]) + torch.tensor([8.0, 10.0]) * dice.normal(*many, 2)
    opposed = torch.cat((opposed, ends), -1)
    thumbs = torch.where(dice.chance(_OPPOSED_SHARE, *many, 1), opposed, beside)
    low, high = torch.tensor(ANGLE_LIMITS)[:5].unbind(1)
    return torch.deg2rad(thumbs).clamp(low, high)


def things_between_tips(
    shape: HandShape, radii: Tensor, shifts: Tensor, bare: Tensor, dice: Dice
) -> tuple[Tensor, Tensor, Tensor]:
    """Hands (N, 21) whose thumb and index finger hold things (N, Q, PART) between their pads, and
    (N,) whether the other fingers close on them, too.
    """
    n = len(bare)
    thumbs, fingers = _opposed_pairs()
    # Sorted by the room between the tips; the narrow ones oftener.
    row = (dice.uniform(n).square() * len(thumbs)).long()
    angles = bare.clone()
    angles[:, :5], angles[:, 5:9] = thumbs[row], fingers[row]
    state = torch.cat((torch.zeros(n, 6), angles), 1)
    pads = _pads(state, shape, radii, shifts)
    across = pads[1][0] - pads[0][0]
    gap = across.norm(dim=1)
    u = across / gap[:, None]
    first, second = radii[:, 0, 2], radii[:, 1, 2]
    thick = (gap - first - second).clamp(min=0.001)
    middle = pads[0][0] + u * (first + 0.5 * thick)[:, None]

    def upright(v: Tensor) -> Tensor:
        return torch.nn.functional.normalize(v - (v * u).sum(1, keepdim=True) * u, dim=1)

    def between(low: float, high: float) -> Tensor:
        return dice.uniform(n, low=low, high=high)

    away = upright(torch.nn.functional.normalize(middle, dim=1) + 0.35 * dice.normal(n, 3))
    side = torch.linalg.cross(u, away)
    flat = torch.stack((side, away, u), 1)  # rows: thickness along the local z
    half = 0.5 * thick
    long, wide = between(0.02, 0.11), between(0.012, 0.075)
    plate_sizes = _no_phone(torch.stack((wide, long, half), 1))
    out = (plate_sizes[:, 1] - between(0.006, 0.025)).clamp(min=0)
    edge = torch.minimum(between(0.0, 0.004), 0.5 * half)
    plate = make_part(BOX, middle + away * out[:, None], flat, plate_sizes, edge)
    disc_radius = between(0.012, 0.075)
    disc_place = middle + away * (disc_radius - between(0.006, 0.025)).clamp(min=0)[:, None]
    disc_rows = torch.stack((side, u, -away), 1)
    disc = make_part(CONE, disc_place, disc_rows, (disc_radius, disc_radius, half), edge)
    # A pen rests on the web between thumb and index finger.
    pen = upright(shape.base_m[:, 1] + 0.012 * dice.normal(n, 3) - middle)
    pen_rows = torch.stack((torch.linalg.cross(pen, u), pen, u), 1)
    pen_half, pen_out = between(0.055, 0.09), between(0.02, 0.05)
    pen_place = middle + pen * (pen_half - pen_out)[:, None]
    pens = make_part(CONE, pen_place, pen_rows, (half * between(0.5, 1.0), half, pen_half))
    cubes = make_part(BOX, middle, flat, (between(0.006, 0.03), between(0.006, 0.03), half), edge)
    ball = make_part(BALL, middle, flat, half[:, None].expand(n, 3))
    tall = between(0.012, 0.07)
    turned = torch.stack((away, -side, u), 1)
    standing = torch.where(dice.chance(0.6, n)[:, None, None], turned, flat)
    middle_2 = middle + standing[:, 1] * (tall * between(-0.7, 0.7))[:, None]
    rounded = torch.minimum(edge, 0.3 * half)
    cylinder = make_part(CONE, middle_2, standing, (half, half, tall), rounded)
    wall = torch.minimum(torch.full((n,), 0.002), 0.3 * half)
    cup = make_part(CONE, middle_2, standing, (half, half, tall.clamp(min=0.02)), wall=wall)
    # Which of them, by how thick they are.
    chances = torch.tensor(list(BETWEEN_TIPS.values())).T
    thickness = torch.bucketize(thick, torch.tensor([0.005, 0.015, 0.03]))
    which = torch.multinomial(chances[thickness], 1, generator=dice.generator)[:, 0]
    parts = _chosen([plate, disc, pens, cubes, ball, cylinder, cup], which)
    # A pen lies on the middle finger.
    closing = dice.chance(torch.where(which == list(BETWEEN_TIPS).index("pen"), 0.85, 0.4), n)
    reaching = torch.deg2rad(torch.tensor([0.0, 15.0, 20.0, 10.0]).repeat(3))
    reaching = reaching + math.radians(6.0) * dice.normal(n, 12)
    reaching = torch.where(dice.chance(0.65, n, 1), reaching, angles[:, 9:])
    angles[:, 9:] = torch.where(closing[:, None], reaching, angles[:, 9:])
    return angles, _thing(parts), closing


def _no_phone(half: Tensor) -> Tensor:
    """Half sizes (N, 3), those of what could be a phone made longer."""
    order = (2 * half).sort(1).values
    thin, wide, long = order.unbind(1)
    (w0, w1), (l0, l1), (t0, t1) = _PHONE_M
    phone = (wide > w0) & (wide < w1) & (long > l0) & (long < l1) & (thin > t0) & (thin < t1)
    longest = torch.nn.functional.one_hot(half.argmax(1), 3)
    return torch.where(phone[:, None], half * (1 + 0.7 * longest), half)


def _pads(
    state: Tensor, shape: HandShape, radii: Tensor, shifts: Tensor
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Points (N, 3) in the last bones of thumb and index finger, and where their pads face."""
    pose = forward_kinematics(state, shape)
    pads = []
    for finger in (0, 1):
        frame, origin = pose.frames[:, 3 + 3 * finger], pose.origins_m[:, 3 + 3 * finger]
        along = 0.62 * (shape.bone_lengths_m[..., finger, 2] - radii[..., finger, 2])
        point = origin - along[..., None] * frame[..., 1]
        pads.append((point - shifts[..., finger, 2, None] * frame[..., 2], -frame[..., 2]))
    return pads[0], pads[1]


@functools.cache
def _opposed_pairs() -> tuple[Tensor, Tensor]:
    """Thumbs (P, 5) and index fingers (P, 4) whose pads face each other, the nearest first."""
    n, dice = 200_000, Dice(torch.Generator().manual_seed(0))
    low, high = torch.tensor(ANGLE_LIMITS)[:5].unbind(1)
    thumb = low + (high - low) * dice.uniform(n, 5)
    thumb[:, 3:] = thumb[:, 3:].clamp(min=-0.1, max=0.9)
    bent = torch.tensor([75.0, 70.0, 40.0]) * dice.uniform(n, 3)
    finger = torch.cat((7.0 * dice.normal(n, 1), bent), 1).deg2rad()
    state = torch.cat((torch.zeros(n, 6), thumb, finger, torch.zeros(n, 12)), 1)
    radii = torch.full((n, 5, 3), 0.0075)
    radii[:, 0] = 0.009
    (a, facing_a), (b, facing_b) = _pads(state, default_hand_shape(), radii, 0.1 * radii)
    across = b - a
    gap = across.norm(dim=1)
    u = across / gap[:, None]
    faced = ((facing_a * u).sum(1) > 0.7) & (-(facing_b * u).sum(1) > 0.7)
    rows = (faced & (gap > 0.017) & (gap < 0.085)).nonzero()[:, 0]
    rows = rows[gap[rows].argsort()]
    return thumb[rows], finger[rows]
