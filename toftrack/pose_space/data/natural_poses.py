"""Natural joint angles to train on: recorded motion and finger-wise mixtures within the limits.

What people show a camera is counting, pinches, thumbs, fists and everything between: each finger is
straight, half bent, hooked or curled, mostly together and often by itself. The ranges are those of
functional motion (Bain et al., J. Hand Surg. Eur. 40(4), 2015; Santello et al., J. Neurosci.
18(23), 1998, for how the fingers go together).
"""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, forward_kinematics

_DATA = Path(__file__).parents[2] / "data" / "natural_poses.npz"

# Degrees (knuckle, middle joint, last joint) and their standard deviations, of the four fingers.
_FINGER_STATES = (
    ((0.0, 3.0, 2.0), (8.0, 6.0, 5.0)),  # straight
    ((85.0, 98.0, 50.0), (10.0, 12.0, 14.0)),  # curled
    ((5.0, 90.0, 50.0), (12.0, 18.0, 18.0)),  # hooked
    ((35.0, 40.0, 20.0), (22.0, 25.0, 14.0)),  # half bent
    ((72.0, 8.0, 4.0), (15.0, 10.0, 6.0)),  # straight, bent at the knuckle
)
_THUMBS = (
    (4, 2, 5, -8, -8),  # out
    (35, -8, 5, -10, -5),  # up
    (-30, 5, -8, 10, 10),  # beside the index finger
    (0, 42, -20, 30, 28),  # across the fingers
    (-12, 35, -15, 55, 60),  # tucked in
    (4, 2, 5, 25, 60),  # hooked
    (10, 20, 0, 15, 20),  # opposed
    (-20, 38, -10, 25, 40),  # folded over the palm
)
_STRAIGHT, _CURLED, _HOOKED, _HALF, _BENT = range(5)
_OUT, _UP, _BESIDE, _ACROSS, _TUCKED, _BENT_THUMB, _OPPOSED, _FOLDED = range(8)
# What people show: the thumbs that go with it, the four fingers, and how often it is drawn.
_SHOWN = (
    ((_OUT, _UP, _BESIDE), (_STRAIGHT,) * 4, 10),  # palm
    ((_ACROSS, _TUCKED, _BENT_THUMB, _BESIDE), (_CURLED,) * 4, 10),  # fist
    ((_ACROSS, _TUCKED, _BENT_THUMB, _FOLDED), (_STRAIGHT, _CURLED, _CURLED, _CURLED), 10),
    ((_OUT, _UP), (_STRAIGHT, _CURLED, _CURLED, _CURLED), 8),  # pointing, without and with thumb
    ((_OUT, _UP), (_CURLED,) * 4, 7),  # thumb up
    ((_ACROSS, _TUCKED, _FOLDED), (_STRAIGHT, _STRAIGHT, _CURLED, _CURLED), 8),  # victory
    ((_OUT, _UP), (_STRAIGHT, _STRAIGHT, _CURLED, _CURLED), 5),
    ((_ACROSS, _TUCKED, _FOLDED), (_STRAIGHT, _STRAIGHT, _STRAIGHT, _CURLED), 5),  # three
    ((_TUCKED, _FOLDED), (_STRAIGHT,) * 4, 6),  # four
    ((_OUT, _ACROSS), (_STRAIGHT, _CURLED, _CURLED, _STRAIGHT), 2),
    ((_OUT, _ACROSS), (_CURLED, _CURLED, _CURLED, _STRAIGHT), 3),
    ((_ACROSS, _TUCKED), (_CURLED, _STRAIGHT, _CURLED, _CURLED), 1),
    ((_OPPOSED,), (_HALF, _STRAIGHT, _STRAIGHT, _STRAIGHT), 4),  # towards OK
    ((_OUT, _OPPOSED), (_HALF,) * 4, 5),  # relaxed
    ((_OUT, _BESIDE), (_HOOKED,) * 4, 3),
    ((_BESIDE, _OPPOSED), (_BENT,) * 4, 2),
)
_SPREAD = (12.0, 2.0, -8.0, -16.0)
_TOUCHING_M = 0.020
FINGER_OF_ANGLE = torch.tensor([0] * 5 + [f for f in range(1, 5) for _ in range(4)])
"""(21,) the finger, thumb 0, that each angle bends."""


def recorded_poses() -> Tensor:
    """(M, 21) joint angles of recorded bare hands, radians (see data/README.md)."""
    with np.load(_DATA, allow_pickle=False) as content:
        return torch.from_numpy(content["angles_centidegrees"].astype(np.float32)) * (
            math.pi / 18000
        )


@functools.cache
def natural_poses() -> Tensor:
    """(M, 21) radians: the recorded poses and as many sampled ones, always the same."""
    with np.load(_DATA, allow_pickle=False) as content:
        return torch.cat((recorded_poses(), torch.from_numpy(content["sampled_rad"])))


def sample_poses(n: int, generator: torch.Generator) -> Tensor:
    """(n, 21) natural joint angles, radians, within the joint limits."""

    def uniform(*size: int) -> Tensor:
        return torch.rand(*size, generator=generator)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator)

    def any_or_shown() -> Tensor:
        shown = uniform(n, 1) < 0.5
        return torch.where(shown, _shown(n, generator), _by_finger(n, generator))

    first, second = any_or_shown(), any_or_shown()
    captured, other = near_recorded(n, generator), near_recorded(n, generator)
    # Fingers of two recorded frames together.
    chosen = uniform(n, 5)[:, FINGER_OF_ANGLE] < 0.5
    crossed = torch.where(chosen, captured, other)
    # On the way from one pose to another, each finger ahead or behind.
    part = (uniform(n, 1) + 0.15 * normal(n, 5)).clamp(0, 1)[:, FINGER_OF_ANGLE]
    moving = torch.lerp(first, second, part)
    pinched = _pinching(first, generator)
    kind = uniform(n, 1)
    angles = first
    for limit, poses in ((0.62, pinched), (0.50, moving), (0.26, crossed), (0.16, captured)):
        angles = torch.where(kind < limit, poses, angles)
    low, high = angles.new_tensor(ANGLE_LIMITS).unbind(1)
    return torch.minimum(torch.maximum(angles, low), high)


def any_fingers(n: int, generator: torch.Generator) -> Tensor:
    """(n, 21) radians, each finger in any state; not yet within the joint limits."""
    return _by_finger(n, generator)


def near_recorded(n: int, generator: torch.Generator) -> Tensor:
    """(n, 21) radians, recorded poses, each a little changed; not yet within the limits."""
    recorded = recorded_poses()
    rows = torch.randint(len(recorded), (n,), generator=generator)
    return recorded[rows] + math.radians(3.0) * torch.randn(n, 21, generator=generator)


def fingers_of_two_recorded(n: int, generator: torch.Generator) -> Tensor:
    """(n, 21) radians, each finger of one of two recorded poses; not yet within the limits."""
    first, second = near_recorded(n, generator), near_recorded(n, generator)
    chosen = torch.rand(n, 5, generator=generator)[:, FINGER_OF_ANGLE] < 0.5
    return torch.where(chosen, first, second)


def _by_finger(n: int, generator: torch.Generator) -> Tensor:
    """(n, 21) each finger in a state: together, straight or curled, or any."""

    def uniform(*size: int) -> Tensor:
        return torch.rand(*size, generator=generator)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator)

    means = torch.tensor([m for m, _ in _FINGER_STATES])
    deviations = torch.tensor([d for _, d in _FINGER_STATES])
    counting = (uniform(n, 4) < 0.5).long()
    anything = torch.randint(len(means), (n, 4), generator=generator)
    kind = uniform(n, 1)
    state = torch.where(kind < 0.55, counting, anything)
    flexion = means[state] + deviations[state] * normal(n, 4, 3)
    # All four together: from straight to curled, the middle joints ahead of the knuckles.
    closing = (uniform(n, 1, 1) * 1.2 - 0.1 + 0.08 * normal(n, 4, 1)).clamp(0, 1)
    exponent = torch.exp(0.35 * normal(n, 1, 3))
    together = means[0] + (means[1] - means[0]) * closing**exponent + 5.0 * normal(n, 4, 3)
    flexion = torch.where(kind[..., None] > 0.75, together, flexion)
    thumbs = torch.tensor(_THUMBS, dtype=torch.float32)
    rows = torch.randint(len(thumbs), (2, n), generator=generator)
    thumb = torch.lerp(thumbs[rows[0]], thumbs[rows[1]], (uniform(n, 1) * 1.6 - 0.3).clamp(0, 1))
    return _assembled(thumb, flexion, generator)


def _shown(n: int, generator: torch.Generator) -> Tensor:
    """(n, 21) what people show a camera, each in an own way."""
    weights = torch.tensor([float(weight) for *_, weight in _SHOWN])
    row = torch.multinomial(weights, n, replacement=True, generator=generator)
    state = torch.tensor([fingers for _, fingers, _ in _SHOWN])[row]
    means = torch.tensor([m for m, _ in _FINGER_STATES])
    deviations = torch.tensor([d for _, d in _FINGER_STATES])
    noise = torch.randn(n, 1, 3, generator=generator)
    # One way of bending for all fingers of a person, and a little of each finger's own.
    noise = 0.6 * noise + 0.6 * torch.randn(n, 4, 3, generator=generator)
    most = max(len(thumbs) for thumbs, *_ in _SHOWN)
    allowed = torch.tensor([(thumbs * most)[:most] for thumbs, *_ in _SHOWN])[row]
    which = torch.randint(most, (2, n), generator=generator)
    first, second = (allowed.gather(1, rows[:, None])[:, 0] for rows in which)
    thumbs = torch.tensor(_THUMBS, dtype=torch.float32)
    part = 0.5 * torch.rand(n, 1, generator=generator)
    thumb = torch.lerp(thumbs[first], thumbs[second], part)
    return _assembled(thumb, means[state] + deviations[state] * noise, generator)


def _assembled(thumb: Tensor, flexion: Tensor, generator: torch.Generator) -> Tensor:
    """(n, 21) radians from thumbs (n, 5) and the fingers' flexions (n, 4, 3), degrees."""
    n = len(thumb)
    part = torch.rand(n, 1, generator=generator) * 1.6 - 0.4
    abduction = torch.tensor(_SPREAD) * part + 4.0 * torch.randn(n, 4, generator=generator)
    fingers = torch.cat((abduction[..., None], flexion), 2).flatten(1)
    thumb = thumb + 8.0 * torch.randn(n, 5, generator=generator)
    return torch.cat((thumb, fingers), 1) * (math.pi / 180)


def _pinching(poses: Tensor, generator: torch.Generator) -> Tensor:
    """The same poses, the thumb touching the index or the middle finger's tip."""
    thumbs, fingers, which = _touching_pairs()
    rows = torch.randint(len(thumbs), (len(poses),), generator=generator)
    pinched = poses.clone()
    pinched[:, :5] = thumbs[rows]
    slots = 5 + 4 * which[rows][:, None] + torch.arange(4)
    return pinched.scatter(1, slots, fingers[rows])


@functools.cache
def _touching_pairs() -> tuple[Tensor, Tensor, Tensor]:
    """Thumbs (P, 5) and fingers (P, 4) whose tips touch, and which finger (P,), 0 = index."""
    generator = torch.Generator().manual_seed(0)
    n = 120_000
    limits = torch.tensor(ANGLE_LIMITS)
    state = torch.zeros(n, 27)
    low, high = limits[:5, 0], limits[:5, 1]
    state[:, 6:11] = low + (high - low) * torch.rand(n, 5, generator=generator)
    flexion = torch.tensor([60.0, 75.0, 45.0]) * torch.rand(n, 1, 3, generator=generator)
    fingers = torch.cat((8.0 * torch.randn(n, 1, 1, generator=generator), flexion), 2)
    state[:, 11:19] = fingers.expand(n, 2, 4).flatten(1) * (math.pi / 180)
    joints = forward_kinematics(state, default_hand_shape()).joints_m
    pairs = []
    for finger in (0, 1):
        gap = (joints[:, 8 + 4 * finger] - joints[:, 4]).norm(dim=1)
        rows = (gap < _TOUCHING_M).nonzero()[:, 0]
        chosen = state[rows]
        slots = slice(11 + 4 * finger, 15 + 4 * finger)
        pairs.append((chosen[:, 6:11], chosen[:, slots], torch.full((len(rows),), finger)))
    thumbs, bent, which = (torch.cat(part) for part in zip(*pairs, strict=True))
    return thumbs, bent, which
