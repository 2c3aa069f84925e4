"""Hands of many people to train on: sizes, proportions and flesh vary, the ellipsoids with them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import roma
import torch
from torch import Tensor

from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, HandShape, default_hand_shape
from toftrack.hand.surface import HandSurface, hand_surface
from toftrack.training.dice import Dice

_SHORTEST_M, _LONGEST_M = 0.135, 0.215
_LONGEST_TIP = 0.42
"""By how much more than the mean shape's a hand's last bones may be longer than its others."""
_CUPPED_FINGERS = (0.0, 0.0, 0.0, 0.45, 1.0)
"""Of the turn of the palm's ulnar edge as a hand closes, each finger's share."""
_CUPPED_PADS = (0.0, 0.0, 0.45, 1.0, 0.0, -0.6, 1.0, 0.0, 0.3)
"""The same of the palm's ellipsoids, in the order of hand/surface.py; the thenar the other way."""
_METACARPALS, _MUSCLES = slice(0, 4), slice(5, 7)
"""Of the palm's ellipsoids: the flesh over the metacarpals, and thenar and hypothenar."""
_HINGE_M = (-0.003, 0.0, -0.004)
"""A point of the line along the palm about which its edge turns, in a mean adult's hand frame."""
_MOST_CUPPED = math.radians(42.0)
"""Turn of the ulnar edge of closed hands, at most."""
_RELAXED = math.radians(4.0)
"""Its standard deviation where the fingers are straight."""
_CLOSED = math.radians(190.0)
"""Flexion of a finger's first two joints that closes the hand."""
_THINNER, _THICKER, _NARROWER = 0.5, 0.7, 0.4
"""At most, of closed hands: the flesh over the metacarpals; thenar and hypothenar, which are
narrower then."""


@dataclass(frozen=True, eq=False)
class ShapeBank:
    """B right hands, stacked so that kinematics and surfaces of a batch need no loop.

    shape: base_m (B, 5, 3), base_frames (B, 5, 3, 3), bone_lengths_m (B, 5, 3).
    surface: centres_m (B, E + 1, 3), axes_m (B, E + 1, 3, 3), one frame_index for all.
    log_size: (B,) logarithm of the hand's length in units of the mean adult's.
    """

    shape: HandShape
    surface: HandSurface
    log_size: Tensor

    def rows(self, rows: Tensor) -> tuple[HandShape, HandSurface]:
        """The hands of (N,) rows, for N states at once."""
        return rows_of(self.shape, self.surface, rows)


def rows_of(shape: HandShape, surface: HandSurface, rows: Tensor) -> tuple[HandShape, HandSurface]:
    """Some of several hands."""
    return (
        HandShape(shape.base_m[rows], shape.base_frames[rows], shape.bone_lengths_m[rows]),
        HandSurface(surface.frame_index, surface.centres_m[rows], surface.axes_m[rows]),
    )


def shape_bank(count: int, generator: torch.Generator) -> ShapeBank:
    """`count` random hands, 135 to 215 mm long before their proportions vary.

    The spreads are wider than those between people (coefficients of variation of 5 to 10 %, ANSUR
    II), so that a real hand, whose surface is no set of ellipsoids, lies within them.
    """
    dice = Dice(generator)
    shapes, surfaces = zip(*(_random_hand(dice) for _ in range(count)), strict=True)
    shape = HandShape(
        torch.stack([one.base_m for one in shapes]),
        torch.stack([one.base_frames for one in shapes]),
        torch.stack([one.bone_lengths_m for one in shapes]),
    )
    centres = torch.stack([one.centres_m for one in surfaces])
    axes = torch.stack([one.axes_m for one in surfaces])
    lengths = torch.tensor([one.hand_length_m for one in shapes])
    surface = HandSurface(surfaces[0].frame_index, centres, axes)
    return ShapeBank(shape, surface, (lengths / DEFAULT_HAND_LENGTH_M).log())


def _random_hand(dice: Dice) -> tuple[HandShape, HandSurface]:
    normal = dice.normal
    log_length = dice.uniform(1) * math.log(_LONGEST_M / _SHORTEST_M)
    mean = default_hand_shape(_SHORTEST_M * math.exp(float(log_length)))
    scale = float(mean.hand_length_m) / DEFAULT_HAND_LENGTH_M
    palm = 1 + torch.tensor([0.08, 0.05, 0.08]) * normal(3)
    base = mean.base_m * palm + 0.002 * scale * normal(5, 3)
    base[0] += 0.003 * scale * normal(3)
    lengths = 1 + 0.05 * normal(1, 1) + 0.05 * normal(5, 1) + 0.03 * normal(5, 3)
    # Against the others, people's last bones are longer than the mean shape's.
    lengths[:, 2] *= 1.0 + _LONGEST_TIP * dice.uniform(1) + 0.04 * normal(5)
    rotations = normal(5, 3) * math.radians(3.0)
    rotations[0] *= 2.5
    frames = mean.base_frames @ roma.rotvec_to_rotmat(rotations)
    thickness = float((1 + 0.10 * normal(1)).clamp(0.75, 1.35))
    shape = HandShape(base, frames, mean.bone_lengths_m * lengths, thickness)
    surface = hand_surface(shape)
    count = len(surface.centres_m)
    scale = shape.hand_length_m / DEFAULT_HAND_LENGTH_M
    grown = 1 + 0.06 * normal(count, 1, 3)
    centres = surface.centres_m + 0.0015 * scale * normal(count, 3)
    return shape, HandSurface(surface.frame_index, centres, surface.axes_m * grown)


def cupped(
    shape: HandShape, surface: HandSurface, angles: Tensor, log_size: Tensor, dice: Dice
) -> tuple[HandShape, HandSurface]:
    """The same hands (N) with hollow palms, as far as their poses (N, 21) close ring and little
    finger.

    The fourth and fifth metacarpal give way when a hand closes, so that the palm's ulnar edge turns
    towards the thumb, and thenar and hypothenar bulge on both sides of a hollow that is 15 to 30 mm
    deep in depth images of fists. The skeleton's angles know nothing of it; its joints move along.
    Networks that never saw it take a fist that shows its palm for one seen from the thumb's side.
    """
    n = len(angles)
    flexion = angles[:, 5:].unflatten(1, (4, 4))[:, 2:, 1:3].sum(2).mean(1)
    closed = (flexion / _CLOSED).clamp(0, 1)
    turn = closed * dice.uniform(n, high=_MOST_CUPPED) + _RELAXED * dice.normal(n)
    hinge = (log_size.exp()[:, None] * torch.tensor(_HINGE_M))[:, None]

    def rotations(shares: tuple[float, ...]) -> Tensor:
        about = torch.zeros(n, len(shares), 3)
        about[..., 1] = -turn[:, None] * torch.tensor(shares)
        return roma.rotvec_to_rotmat(about)

    def turned(points: Tensor, by: Tensor) -> Tensor:
        return hinge + (by @ (points - hinge)[..., None])[..., 0]

    of_fingers, of_pads = rotations(_CUPPED_FINGERS), rotations(_CUPPED_PADS)
    wide, deep = torch.ones(2, n, len(_CUPPED_PADS))
    some = closed[:, None]
    deep[:, _METACARPALS] = 1 - some * dice.uniform(n, 1, low=-0.05, high=_THINNER)
    deep[:, _MUSCLES] = 1 + some * dice.uniform(n, 2, low=-0.05, high=_THICKER)
    wide[:, _MUSCLES] = 1 - some * dice.uniform(n, 2, high=_NARROWER)
    centres, axes = surface.centres_m.clone(), surface.axes_m.clone()
    first = centres.shape[1] - 1 - len(_CUPPED_PADS)  # behind the fingers, before the wrist
    pads = slice(first, first + len(_CUPPED_PADS))
    # A pad's third axis is its depth. Its back stays where it is, the palm is at -z.
    lost = axes[:, pads, :, 2].norm(dim=2) * (1 - deep)
    back = of_pads @ torch.tensor([0.0, 0.0, 1.0])
    centres[:, pads] = turned(centres[:, pads], of_pads) + back * lost[..., None]
    axes[:, pads] = of_pads @ axes[:, pads]
    axes[:, pads, :, 0] *= wide[..., None]
    axes[:, pads, :, 2] *= deep[..., None]
    base = turned(shape.base_m, of_fingers)
    return (
        HandShape(base, of_fingers @ shape.base_frames, shape.bone_lengths_m),
        HandSurface(surface.frame_index, centres, axes),
    )
