"""Short recordings of random scenes: a hand that moves, as a whole camera sees it.

They calibrate the tracker's confidence: other hands, persons and sensors than any recording that it
is judged on, and hands whose proportions and flesh are not those of the tracker's model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import roma
import torch
from torch import Tensor

from toftrack.training.dice import Dice
from toftrack.training.hands import HAND, posed_hands, random_rotations, random_views
from toftrack.training.images import FURNISHED, HAND_M2, furnished, other_hands, random_scenes
from toftrack.training.pictures import Lens, random_sensors, take_pictures
from toftrack.training.shapes import ShapeBank
from toftrack.training.shown_poses import shown_poses

CAMERAS = ((176, 144, 200.0), (176, 144, 200.0), (320, 240, 280.0), (512, 424, 365.0))
"""Columns, rows and focal length in pixels."""
_KEY = 14
"""Frames between two poses that are drawn."""
_EMPTY_SHARE = 0.25
_STILL_SHARE = 0.55
"""Scenes in which the fingers do not move; in hands.HOLDING of them the hand tries to hold a
thing."""


@dataclass(frozen=True, eq=False)
class Sequence:
    """A recording with truth.

    depth_m: (T, H, W) float32, 0 = no reading.  k: (3, 3).  joints_m: (T, 21, 3).
    visible: (T,) a tenth of the hand is in view.  side: whose hand it is.
    """

    depth_m: np.ndarray
    k: np.ndarray
    joints_m: np.ndarray
    visible: np.ndarray
    side: str


def random_sequence(frames: int, bank: ShapeBank, generator: torch.Generator) -> Sequence:
    """One random scene: `frames` images at 25 frames/s of one hand in its surroundings.

    In a quarter of the scenes there is no hand at all, and in most of these furniture; in some a
    hand holds a thing.
    """
    dice = Dice(generator)
    width, height, focal = CAMERAS[int(dice.rows(len(CAMERAS), 1))]
    keys = frames // _KEY + 2
    left, empty = dice.chance(0.5, 1), bool(dice.chance(_EMPTY_SHARE, 1))
    still = bool(dice.chance(_STILL_SHARE, 1))
    place = _places(keys, width / focal, height / focal, dice)
    views = random_views(1, dice)
    rotations = _rotations(keys, dice, views)
    angles = _held(shown_poses(keys, dice), dice)
    there = dice.chance(FURNISHED[empty], 1)
    others = 0.0 if empty else 0.2  # which may be as right a hand as the missing one
    scene = int(torch.randint(2**31 - 1, (1,), generator=generator))
    sensor = random_sensors(1, dice)
    k = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    lens = Lens(*torch.tensor([[focal], [k[0, 2]], [k[1, 2]], [width], [height]]))
    images, joints, seen = [], [], []
    for frame in range(frames):
        key, part = divmod(frame / _KEY, 1)
        key, smooth = int(key), 0.5 - 0.5 * math.cos(math.pi * part)
        turn = roma.rotmat_slerp(rotations[key], rotations[key + 1], torch.tensor(smooth))
        pose = None if still else torch.lerp(angles[key], angles[key + 1], smooth)[None]
        pivot = torch.lerp(place[key], place[key + 1], smooth)
        # The same draws in every frame: the scene stays, only the hand moves.
        same = Dice(torch.Generator().manual_seed(scene))
        hands = posed_hands(bank, pivot[None], left, same, HAND, turn[None], pose)
        labels = torch.where(hands.labels == HAND, -1, hands.labels) if empty else hands.labels
        other = other_hands(hands, bank, same, touching=torch.tensor([True]))
        second = other, same.chance(others, 1)
        scenes = random_scenes(hands, labels, second, same, objects=0.06, views=views)
        scenes = furnished(scenes, there, same)
        depth, which = take_pictures(scenes, lens, sensor, (height, width), dice)
        images.append(depth[0])
        joints.append(hands.joints_m[0])
        area = (focal / float(pivot[2])) ** 2 * HAND_M2 * math.exp(2 * float(hands.log_size))
        seen.append((which == HAND).sum() / area > 0.1)
    side = "left" if bool(left) else "right"
    return Sequence(np.stack(images), k, torch.stack(joints).numpy(), np.array(seen), side)


def _places(keys: int, wide: float, high: float, dice: Dice) -> Tensor:
    """(keys, 3) middles of the palm: mostly in view, near each other, sometimes far out."""
    z = dice.uniform(1, low=0.32, high=0.85)
    walk = torch.cumsum(torch.tensor([0.06, 0.06, 0.03]) * dice.normal(keys, 3), 0)
    z = (z + walk[:, 2]).clamp(0.26, 1.0)
    x = 0.25 * wide * dice.uniform(1, low=-1, high=1) * z + walk[:, 0]
    y = 0.25 * high * dice.uniform(1, low=-1, high=1) * z + walk[:, 1]
    away = dice.chance(0.06, keys)
    x = torch.where(away, x + 0.9 * wide * z, x)
    return torch.stack((x, y, z), 1)


def _rotations(keys: int, dice: Dice, views: Tensor) -> Tensor:
    """(keys, 3, 3) rotations that follow from one another, for a camera at views (1,)."""
    rotations = [random_rotations(1, dice, views)[0]]
    for _ in range(keys - 1):
        step = roma.rotvec_to_rotmat(0.35 * dice.normal(3))
        rotations.append(step @ rotations[-1])
    return torch.stack(rotations)


def _held(angles: Tensor, dice: Dice) -> Tensor:
    """Poses (keys, 21), a third of them held on to the next."""
    for key in range(1, len(angles)):
        if bool(dice.chance(0.33, 1)):
            angles[key] = angles[key - 1]
    return angles
