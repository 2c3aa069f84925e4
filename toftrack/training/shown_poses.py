"""Poses that people show a camera or pass through, to train the detector on.

KINDS and SHOWN say how often each is drawn; docs/detector.md has KINDS as a table. Poses of hands
that hold things follow from the things: hands.py.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, forward_kinematics
from toftrack.pose_space.base import clamp_to_joint_limits
from toftrack.pose_space.data.pose_data import THUMBS, recorded_poses
from toftrack.training.dice import Dice

KINDS = {
    "shown": 0.42,  # SHOWN
    "pinch": 0.16,  # the thumb's tip on that of any finger, the other fingers as shown, or any
    "moving": 0.19,  # between two that are shown, or one of them and any fingers
    "any": 0.08,  # each finger straight, half bent, hooked or curled
    "recorded": 0.09,
    "crossed": 0.06,  # fingers of two recorded poses
}
"""How often poses of each kind are drawn."""

# Degrees (knuckle, middle joint, last joint) and their standard deviations.
_STATES = {
    "straight": ((0, 3, 2), (8, 6, 5)),
    "back": ((-14, 4, 0), (8, 5, 5)),  # bent backwards a little, as of a hand stretched out
    "tight": ((86, 105, 65), (5, 6, 8)),  # as a fist closes: the tip is 24 to 35 mm off the knuckle
    "loose": ((74, 92, 45), (11, 12, 14)),
    "folded": ((38, 115, 72), (18, 5, 9)),  # as tight, over knuckles that are bent half or less
    "hooked": ((5, 92, 55), (12, 14, 16)),
    "claw": ((-8, 52, 38), (9, 14, 13)),
    "half": ((35, 40, 20), (18, 20, 13)),
    "curved": ((38, 38, 24), (9, 10, 9)),  # around a jar
    "round": ((58, 52, 34), (8, 9, 9)),  # towards the thumb's tip
    "bent": ((75, 7, 4), (13, 8, 6)),  # straight, bent at the knuckle
    "over": ((70, 75, 25), (9, 12, 10)),  # over the thumb
}
_THUMBS = THUMBS | {"opposed": (10, 20, 0, 15, 20), "folded": (-20, 38, -10, 25, 40)}
# What any finger may do: straight, curled, hooked, half bent, bent at the knuckle.
_ANY_MEANS = torch.tensor(
    [(0.0, 3.0, 2.0), (85.0, 98.0, 50.0), (5.0, 90.0, 50.0), (35.0, 40.0, 20.0), (72.0, 8.0, 4.0)]
)
_ANY_DEVIATIONS = torch.tensor(
    [(8.0, 6.0, 5.0), (10.0, 12.0, 14.0), (12.0, 18.0, 18.0), (22.0, 25.0, 14.0), (15.0, 10.0, 6.0)]
)
_FINGER_OF_ANGLE = torch.tensor([0] * 5 + [f for f in range(1, 5) for _ in range(4)])
"""(21,) the finger, thumb 0, that each angle bends."""
_APART, _TOGETHER, _ANY, _CROSSED = range(4)
_SPREAD = (12.0, 2.0, -8.0, -16.0)
"""Degrees of abduction of fingers that are spread; about -1 times it, they touch."""
_BENT_SPREAD = (-1.5, 1.0)
"""What bent fingers have of it: the tips of hooked ones lie side by side, those of a fist converge
on one place of the palm, so that their knuckles' axes do not."""
_BENT_DEG = 70.0


class Shown(NamedTuple):
    """What people show. thumbs: any of these.  fingers: four states, index finger first."""

    name: str
    thumbs: tuple[str, ...]
    fingers: tuple[str, ...]
    spread: int
    weight: float


_UP = ("out", "up")
_CLOSED = ("across", "tucked", "hooked", "folded")
SHOWN = (
    Shown("palm", ("out", "up", "beside"), 4 * ("straight",), _APART, 6),
    Shown("stretched palm", _UP, 4 * ("back",), _APART, 5),
    Shown("flat", ("beside", "beside", "beside", "out"), 4 * ("straight",), _TOGETHER, 11),
    Shown("flat, thumb away", ("up", "out"), 4 * ("straight",), _TOGETHER, 4),
    Shown("fist", ("across", "across", "beside", "hooked"), 4 * ("tight",), _TOGETHER, 18),
    Shown("fist about the thumb", ("tucked", "folded"), 4 * ("over",), _TOGETHER, 2),
    Shown("loose fist", _CLOSED, 4 * ("loose",), _ANY, 3),
    Shown("thumb up", ("up", "out", "up"), 4 * ("tight",), _TOGETHER, 15),
    Shown("thumb up, loose", ("up", "out"), 4 * ("loose",), _ANY, 2),
    Shown("point", _CLOSED, ("straight", "tight", "tight", "tight"), _ANY, 7),
    Shown("point, loose", _CLOSED, ("straight", "loose", "loose", "loose"), _ANY, 3),
    Shown("point with thumb", _UP, ("straight", "tight", "tight", "tight"), _ANY, 7),
    Shown("point with thumb, loose", _UP, ("straight", "loose", "loose", "loose"), _ANY, 3),
    Shown("bent index", _CLOSED, ("hooked", "tight", "tight", "tight"), _ANY, 2),
    Shown("victory", _CLOSED, ("straight", "straight", "tight", "tight"), _APART, 6),
    Shown("victory with thumb", _UP, ("straight", "straight", "tight", "tight"), _ANY, 3),
    Shown("two together", _CLOSED, ("straight", "straight", "tight", "tight"), _TOGETHER, 3),
    Shown("crossed fingers", _CLOSED, ("straight", "half", "tight", "tight"), _CROSSED, 1),
    Shown("three", _CLOSED, ("straight", "straight", "straight", "tight"), _ANY, 5),
    Shown("four", ("tucked", "folded", "across"), 4 * ("straight",), _ANY, 5),
    Shown("flat, thumb folded", ("folded", "across", "tucked"), 4 * ("straight",), _TOGETHER, 3),
    Shown("index and little", _CLOSED, ("straight", "tight", "tight", "straight"), _ANY, 4),
    Shown("thumb, index and little", _UP, ("straight", "tight", "tight", "straight"), _ANY, 3),
    Shown("little", _CLOSED, ("tight", "tight", "tight", "straight"), _ANY, 6),
    Shown("thumb and little", _UP, ("tight", "tight", "tight", "straight"), _ANY, 3),
    Shown("middle", _CLOSED, ("tight", "straight", "tight", "tight"), _ANY, 1),
    Shown("bent knuckles", ("beside", "opposed", "out"), 4 * ("bent",), _ANY, 6),
    Shown("flat beak", ("opposed", "across"), 4 * ("bent",), _TOGETHER, 2),
    Shown("hook", ("out", "beside", "up", "across"), 4 * ("hooked",), _ANY, 6),
    Shown("claw", ("out", "up", "opposed"), 4 * ("claw",), _APART, 4),
    Shown("curved", ("opposed", "out"), 4 * ("curved",), _TOGETHER, 3),
    Shown("all tips together", ("opposed", "across"), 4 * ("round",), _TOGETHER, 2),
    Shown(
        "one up, the others round", ("opposed",), ("straight", "round", "round", "round"), _ANY, 2
    ),
    Shown("relaxed", ("out", "opposed", "beside"), 4 * ("half",), _ANY, 6),
)
_FLAT_KNUCKLES = 0.4
"""How many of those who close fingers hardly bend their knuckles: tight ones are folded."""
_TOUCHING_M = 0.020
_ONE_BY_ONE = 0.25
"""Standard deviation of how much further than its neighbour a finger is on its way."""


def shown_poses(n: int, dice: Dice) -> Tensor:
    """(n, 21) joint angles, radians, within the joint limits, of KINDS."""
    shown, second = shown_only(n, dice), shown_only(n, dice)
    fingers = any_fingers(n, dice)
    other = torch.where(dice.uniform(n, 1) < 0.3, fingers, second)
    moving = on_the_way(shown, other, dice)
    poses = {
        "shown": shown,
        "pinch": pinched(torch.where(dice.uniform(n, 1) < 0.3, fingers, second), dice),
        "moving": moving,
        "any": fingers,
        "recorded": near_recorded(n, dice),
        "crossed": fingers_of_two_recorded(n, dice),
    }
    kind = torch.multinomial(torch.tensor(list(KINDS.values())), n, True, generator=dice.generator)
    angles = torch.stack([poses[name] for name in KINDS])[kind, torch.arange(n)]
    return clamp_to_joint_limits(angles)


def on_the_way(first: Tensor, last: Tensor, dice: Dice) -> Tensor:
    """(n, 21) between poses (n, 21) and others: each finger ahead or behind, and in half of them
    one after another, as a hand opens or closes from one side on.
    """
    n = len(first)
    one_by_one = _ONE_BY_ONE * dice.normal(n, 1) * (torch.arange(5.0) - 2.0)
    part = dice.uniform(n, 1) + 0.15 * dice.normal(n, 5)
    some = dice.uniform(n, 1) < 0.5
    part = (part + torch.where(some, one_by_one, 0.0)).clamp(0, 1)
    return torch.lerp(first, last, part[:, _FINGER_OF_ANGLE])


def near_recorded(n: int, dice: Dice) -> Tensor:
    """(n, 21) radians, recorded poses, each a little changed; not yet within the limits."""
    recorded = recorded_poses()
    return recorded[dice.rows(len(recorded), n)] + math.radians(3.0) * dice.normal(n, 21)


def fingers_of_two_recorded(n: int, dice: Dice) -> Tensor:
    """(n, 21) radians, each finger of one of two recorded poses; not yet within the limits."""
    first, second = near_recorded(n, dice), near_recorded(n, dice)
    chosen = dice.uniform(n, 5)[:, _FINGER_OF_ANGLE] < 0.5
    return torch.where(chosen, first, second)


def any_fingers(n: int, dice: Dice) -> Tensor:
    """(n, 21) radians, each finger straight or curled, or in any state, or all closing together;
    not yet within the limits.
    """
    counting = (dice.uniform(n, 4) < 0.5).long()
    anything = torch.randint(len(_ANY_MEANS), (n, 4), generator=dice.generator)
    kind = dice.uniform(n, 1)
    state = torch.where(kind < 0.55, counting, anything)
    flexion = _ANY_MEANS[state] + _ANY_DEVIATIONS[state] * dice.normal(n, 4, 3)
    # All four together: from straight to curled, the middle joints ahead of the knuckles.
    closing = dice.uniform(n, 1, 1) * 1.2 - 0.1 + 0.08 * dice.normal(n, 4, 1)
    exponent = torch.exp(0.35 * dice.normal(n, 1, 3))
    straight, curled = _ANY_MEANS[:2]
    together = straight + (curled - straight) * closing.clamp(0, 1) ** exponent
    together = together + 5.0 * dice.normal(n, 4, 3)
    flexion = torch.where(kind[..., None] > 0.75, together, flexion)
    thumbs = torch.tensor(list(_THUMBS.values()), dtype=torch.float32)
    first, last = torch.randint(len(thumbs), (2, n), generator=dice.generator)
    part = (dice.uniform(n, 1) * 1.6 - 0.3).clamp(0, 1)
    thumb = torch.lerp(thumbs[first], thumbs[last], part)
    spread = torch.tensor(_SPREAD) * (dice.uniform(n, 1) * 1.6 - 0.4)
    abduction = spread + 4.0 * dice.normal(n, 4)
    fingers = torch.cat((abduction[..., None], flexion), 2).flatten(1)
    thumb = thumb + 8.0 * dice.normal(n, 5)
    return torch.deg2rad(torch.cat((thumb, fingers), 1))


def shown_only(n: int, dice: Dice, rows: Tensor | None = None) -> Tensor:
    """(n, 21) of SHOWN, by its weights or of these rows, each in an own way."""
    if rows is None:
        weights = torch.tensor([float(shown.weight) for shown in SHOWN])
        rows = torch.multinomial(weights, n, True, generator=dice.generator)
    names = list(_STATES)
    state = torch.tensor([[names.index(f) for f in shown.fingers] for shown in SHOWN])[rows]
    flat = (dice.uniform(n, 1) < _FLAT_KNUCKLES) & (state == names.index("tight"))
    state = torch.where(flat, names.index("folded"), state)
    means = torch.tensor([mean for mean, _ in _STATES.values()], dtype=torch.float32)
    deviations = torch.tensor([deviation for _, deviation in _STATES.values()], dtype=torch.float32)
    # One way of bending for all fingers of a person, and a little of each finger's own.
    noise = 0.6 * dice.normal(n, 1, 3) + 0.6 * dice.normal(n, 4, 3)
    flexion = means[state] + deviations[state] * noise
    spread = torch.tensor([shown.spread for shown in SHOWN])[rows]
    return torch.cat((_thumbs(rows, dice), _fingers(flexion, spread, dice)), 1)


def _thumbs(rows: Tensor, dice: Dice) -> Tensor:
    """(n, 5) radians, one that goes with what is shown, or between two."""
    n = len(rows)
    names = list(_THUMBS)
    most = max(len(shown.thumbs) for shown in SHOWN)
    allowed = [[names.index(name) for name in (shown.thumbs * most)[:most]] for shown in SHOWN]
    which = torch.randint(most, (2, n), generator=dice.generator)
    first, second = (torch.tensor(allowed)[rows].gather(1, w[:, None])[:, 0] for w in which)
    thumbs = torch.tensor(list(_THUMBS.values()), dtype=torch.float32)
    thumb = torch.lerp(thumbs[first], thumbs[second], 0.5 * dice.uniform(n, 1))
    return torch.deg2rad(thumb + 7.0 * dice.normal(n, 5))


def _fingers(flexion: Tensor, spread: Tensor, dice: Dice) -> Tensor:
    """(n, 16) radians from flexions (n, 4, 3) in degrees and how fingers are spread (n,)."""
    n = len(spread)
    wide, least = torch.tensor([[1.3, 0.35, 1.6, 0.5], [0.3, -1.2, -0.6, -0.2]])
    kinds = dice.uniform(4, n).T * wide + least
    part = kinds.gather(1, spread[:, None])
    own = torch.where(spread == _TOGETHER, 1.2, 4.0)[:, None]
    bent_part = _BENT_SPREAD[0] + (_BENT_SPREAD[1] - _BENT_SPREAD[0]) * dice.uniform(n, 1)
    bent = (flexion[..., :2].amax(2) / _BENT_DEG).clamp(0, 1)
    part = torch.lerp(part.expand(n, 4), bent_part.expand(n, 4), bent)
    abduction = torch.tensor(_SPREAD) * part + own * dice.normal(n, 4)
    across = torch.tensor([-14.0, 10.0, 0.0, 0.0])
    abduction = torch.where((spread == _CROSSED)[:, None], abduction + across, abduction)
    return torch.deg2rad(torch.cat((abduction[..., None], flexion), 2).flatten(1))


def pinched(poses: Tensor, dice: Dice) -> Tensor:
    """The same poses (N, 21), the thumb's tip touching that of one finger, each as often."""
    pairs = touching_pairs()
    finger = dice.rows(4, len(poses))
    part = dice.uniform(len(poses))
    row = torch.stack([(part * len(thumbs)).long() for thumbs, _ in pairs], 1)
    result = poses.clone()
    for number, (thumbs, fingers) in enumerate(pairs):
        use = (finger == number).nonzero()[:, 0]
        rows = row[use, number]
        result[use, :5] = thumbs[rows]
        result[use, 5 + 4 * number : 9 + 4 * number] = fingers[rows]
    return result


@functools.cache
def touching_pairs() -> tuple[tuple[Tensor, Tensor], ...]:
    """Thumbs (P, 5) and fingers (P, 4), for each finger, whose tips are so near to each other."""
    n, dice = 60_000, Dice(torch.Generator().manual_seed(0))
    low, high = torch.tensor(ANGLE_LIMITS)[:5].unbind(1)
    thumb = low + (high - low) * dice.uniform(n, 5)
    thumb[:, 3:] = thumb[:, 3:].clamp(min=-0.1)
    bent = torch.tensor([75.0, 80.0, 50.0]) * dice.uniform(n, 3)
    fingers = torch.cat((8.0 * dice.normal(n, 1), bent), 1).deg2rad()
    state = torch.cat((torch.zeros(n, 6), thumb, fingers.repeat(1, 4)), 1)
    joints = forward_kinematics(state, default_hand_shape()).joints_m
    found = []
    for finger in range(4):
        near = (joints[:, 8 + 4 * finger] - joints[:, 4]).norm(dim=1) < _TOUCHING_M
        found.append((thumb[near], fingers[near]))
    return tuple(found)
