"""The hand as OpenXR has it: the 26 joints of XR_EXT_hand_tracking.

From the specification's "Conventions of hand joints": a joint is named after the bone that begins
there. Its backward axis (+Z) lies along that bone and points away from the fingertip, its up axis
(+Y) points out of the nail's side of the finger, or the back of the hand, and X follows by the
right-hand rule, on both hands. Wrist: -Z points at the middle finger's metacarpal joint. Palm: in
the middle of the middle finger's metacarpal, with that bone's direction. A joint's radius is its
distance to the skin. World axes: x right, y up, -z forward, where the camera has x right, y down,
z forward.

The skeleton has no metacarpals of the four fingers. Their joints are set by ratios of Buchholz,
Armstrong and Goldstein, "Anthropometric data for describing the kinematics of the human hand"
(Ergonomics 35, 1992), as the models of Sancho-Bru and others use them: so far below the knuckle as
_METACARPAL says, and nearer to the middle finger's ray than the knuckle by the factor of _INWARD.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import torch

from toftrack.compute.rotations import unitquat_to_rotmat
from toftrack.hand.regions import lengths
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import FINGERS, forward_kinematics
from toftrack.hand.surface import Ellipsoids, hand_surface

OPENXR_JOINT_NAMES: tuple[str, ...] = (
    "palm",
    "wrist",
    *(f"thumb_{joint}" for joint in ("metacarpal", "proximal", "distal", "tip")),
    *(
        f"{finger}_{joint}"
        for finger in FINGERS[1:]
        for joint in ("metacarpal", "proximal", "intermediate", "distal", "tip")
    ),
)
"""In the order of XrHandJointEXT."""
OPENXR_PARENTS: tuple[int, ...] = (
    *(1, -1, 1, 2, 3, 4),
    *(1 if joint == 0 else 5 + 5 * finger + joint for finger in range(4) for joint in range(5)),
)
"""Which joint each one hangs on in a skeleton with the wrist as its root, which has -1."""

_METACARPAL = np.array([0.374, 0.373, 0.336, 0.295])
"""Of index to little finger: length along the hand, in lengths of the hand."""
_INWARD = np.array([0.126 / 0.252, 1.0, 0.129 / 0.206, 0.223 / 0.402])
"""Distance of the metacarpal's base from the middle finger's ray, in that of its knuckle."""

_NEIGHBOURHOOD_M = np.linspace(-0.008, 0.008, 5)
"""Places along the bone at which the flesh about a joint is measured."""
_WORLD = np.array([1.0, -1.0, -1.0])
"""The camera's axes in the world's: half a turn about x."""

# Joints of the 21 that are joints of OpenXR as they are, and where these stand there.
_SAME = [0, 1, 2, 3, *(4 * finger + joint for finger in range(1, 5) for joint in (1, 2, 3))]
JOINT_OF_FRAME = [1, 2, 3, 4, *(first + bone for first in (7, 12, 17, 22) for bone in range(3))]
"""Which joint of OpenXR moves as each of the 16 frames of a HandPose does."""
_TIPS, _TIPS_THERE = [4, 8, 12, 16, 20], [5, 10, 15, 20, 25]
_METACARPALS_THERE = [6, 11, 16, 21]
_KNUCKLES = [5, 9, 13, 17]
_STARTS = [4 * finger + joint for finger in range(5) for joint in (1, 2, 3)]
"""The proximal ends of the 15 bones, finger by finger; their distal ends come right after."""
_ENDS = [start + 1 for start in _STARTS]
# Bones of which each joint has the axes: the 15, the four metacarpals, wrist to middle metacarpal.
_MIDDLE_METACARPAL, _WRIST = 16, 19
_BONE_OF = [
    _MIDDLE_METACARPAL,
    _WRIST,
    *(0, 1, 2, 2),
    *(b for f in range(1, 5) for b in (14 + f, 3 * f, 3 * f + 1, 3 * f + 2, 3 * f + 2)),
]
_FIRST_ABDUCTION = [6, 11, 15, 19, 23]
"""Of each finger's first bone, in the 27 numbers of a state."""
_SECOND_ABDUCTION = 8
"""Of the thumb's second bone; no other bone has one."""


class OpenXRHand(NamedTuple):
    """Hands with any leading axes, in the world of OpenXR.

    position_m: (..., 26, 3).  orientation: (..., 26, 4) unit quaternions x y z w, w not negative.
    radius_m: (..., 26).
    """

    position_m: np.ndarray
    orientation: np.ndarray
    radius_m: np.ndarray


class OpenXRRig(NamedTuple):
    """What of a hand's shape does not move.

    base_frames: (5, 3, 3) of the fingers, in the hand's frame.
    metacarpals_m: (4, 3) where the metacarpals of index to little finger begin, likewise.
    radius_m: (26,).
    mirrored: a left hand.
    """

    base_frames: np.ndarray
    metacarpals_m: np.ndarray
    radius_m: np.ndarray
    mirrored: bool


def openxr_hand(joints_m: np.ndarray, state: np.ndarray, rig: OpenXRRig) -> OpenXRHand:
    """Joints and states of hands as OpenXR has them; NaN where there is no hand.

    Algorithm, all bones at once:
      1. A bone's direction d is that of its two joints. It bends about an axis x, which abduction
         turns in the finger's base frame; the thumb's second bone turns it once more.
      2. The nail's side is d x x for right hands, and the other way for left ones, whose frames
         are mirrored inside; so -Z = d, +Y = the nail's side, X = Y x Z is right-handed on both.

    joints_m: (..., 21, 3) metres, camera frame.
    state: (..., 27) of the same hands, see hand.skeleton.
    """
    joints = np.asarray(joints_m, np.float64)
    state = np.asarray(state, np.float64)
    shape = joints.shape[:-2]
    joints, state = joints.reshape(-1, 21, 3), state.reshape(-1, 27)
    known = np.isfinite(joints).all((1, 2)) & np.isfinite(state).all(1)
    position = np.full((len(joints), 26, 3), np.nan)
    orientation = np.full((len(joints), 26, 4), np.nan)
    radius = np.full((len(joints), 26), np.nan)
    if known.any():
        position[known], orientation[known] = _placed(joints[known], state[known], rig)
        radius[known] = rig.radius_m
    return OpenXRHand(
        position.reshape(*shape, 26, 3),
        orientation.reshape(*shape, 26, 4),
        radius.reshape(*shape, 26),
    )


def _placed(joints: np.ndarray, state: np.ndarray, rig: OpenXRRig) -> tuple[np.ndarray, np.ndarray]:
    """(N, 21, 3) and (N, 27) to positions (N, 26, 3) and quaternions (N, 26, 4) in the world."""
    from scipy.spatial.transform import Rotation  # a tenth of a second, which few runs need

    palm = Rotation.from_rotvec(state[:, 3:6]).as_matrix()
    if rig.mirrored:
        palm = palm * np.array([-1.0, 1.0, 1.0])
    metacarpals = joints[:, :1] + rig.metacarpals_m @ palm.swapaxes(1, 2)
    bases = palm[:, None] @ rig.base_frames  # (N, 5, 3, 3)
    phalanges = joints[:, _ENDS] - joints[:, _STARTS]
    ways = np.concatenate(
        (phalanges, joints[:, _KNUCKLES] - metacarpals, metacarpals[:, 1:2] - joints[:, :1]), 1
    )
    ways /= lengths(ways)
    hinges = np.concatenate(
        (_hinges(ways, bases, state), bases[:, 1:, :, 0], palm[:, None, :, 0]), 1
    )
    nails = _cross(hinges, ways) if rig.mirrored else _cross(ways, hinges)
    nails /= lengths(nails)
    ways, nails = _WORLD * ways, _WORLD * nails
    axes = np.stack((_cross(ways, nails), nails, -ways), -1)  # X = Y x Z = -Z x Y
    turned = Rotation.from_matrix(axes.reshape(-1, 3, 3)).as_quat(canonical=True)

    position = np.empty((len(joints), 26, 3))
    position[:, JOINT_OF_FRAME] = _WORLD * joints[:, _SAME]
    position[:, _METACARPALS_THERE] = _WORLD * metacarpals
    inset = rig.radius_m[_TIPS_THERE][:, None]
    position[:, _TIPS_THERE] = _WORLD * joints[:, _TIPS] - inset * ways[:, 2:15:3]
    position[:, 0] = (position[:, 11] + position[:, 12]) / 2
    return position, turned.reshape(-1, 20, 4)[:, _BONE_OF]


def _hinges(ways: np.ndarray, bases: np.ndarray, state: np.ndarray) -> np.ndarray:
    """(N, 15, 3) axes about which the phalanges bend; the fingers' base frames are (N, 5, 3, 3)."""
    first = state[:, _FIRST_ABDUCTION, None]
    hinge = np.cos(first) * bases[..., 0] + np.sin(first) * bases[..., 1]
    hinges = np.repeat(hinge[:, :, None], 3, 2)
    second = state[:, _SECOND_ABDUCTION, None]
    thumb = np.cos(second) * hinge[:, 0] - np.sin(second) * ways[:, 0]
    hinges[:, 0, 1:] = thumb[:, None]
    return hinges.reshape(-1, 15, 3)


@functools.lru_cache(maxsize=8)
def openxr_rig(shape: HandShape) -> OpenXRRig:
    """What openxr_hand needs of a shape: milliseconds for a new one, kept for one that was met.

    A joint's radius is half of the flesh's thickness from the nail's side to the other, with
    straight fingers, in the mean over the joint's neighbourhood, since ellipsoids leave a waist
    where they meet. A fingertip's joint lies so far inside the tip that a sphere of its radius
    touches both the tip and the skin on either side.
    """
    shape = shape.to("cpu", torch.float64)
    base = shape.base_m.numpy()
    knuckles = base[1:]
    starts = np.stack(
        (
            base[2, 0] + _INWARD * (knuckles[:, 0] - base[2, 0]),
            knuckles[:, 1] + _METACARPAL * shape.hand_length_m,
            np.zeros(4),
        ),
        1,
    )
    # As deep in the palm as the line from the wrist to the knuckle is there.
    starts[:, 2] = knuckles[:, 2] * starts[:, 1] / knuckles[:, 1]
    surface = hand_surface(shape)
    rest = forward_kinematics(torch.zeros(1, 27, dtype=torch.float64), shape)
    flesh = surface.pose(rest)
    radius = np.zeros(26)
    for finger in range(5):
        _, along, depth = surface.axes_m[surface.frame_index == 3 + 3 * finger][0].diagonal()
        radius[_TIPS_THERE[finger]] = 2 * along * depth**2 / (along**2 + depth**2)
    rig = OpenXRRig(shape.base_frames.numpy(), starts, radius, shape.side == "left")
    hand = openxr_hand(rest.joints_m[0].numpy(), np.zeros(27), rig)
    axes = unitquat_to_rotmat(torch.from_numpy(hand.orientation)).numpy()
    _, up, back = np.moveaxis(axes, 2, 0)
    points = hand.position_m + _NEIGHBOURHOOD_M[:, None, None] * back
    ways = np.broadcast_to(_WORLD * up, points.shape)
    thickness = _thickness((_WORLD * points).reshape(-1, 3), ways.reshape(-1, 3), flesh)
    thickness = thickness.reshape(-1, 26).mean(0)
    return rig._replace(radius_m=np.where(radius > 0, radius, thickness / 2))


def _thickness(points: np.ndarray, ways: np.ndarray, flesh: Ellipsoids) -> np.ndarray:
    """(P,) how long the lines through points (P, 3) along ways (P, 3) are within the flesh there.

    Of the ellipsoids, but the wrist's, only those that hold the point count.
    """
    inverse = np.linalg.inv(flesh.axes_m[0, :-1].numpy())  # (E, 3, 3)
    start = np.einsum("eab,peb->pea", inverse, points[:, None] - flesh.centres_m[0, :-1].numpy())
    way = np.einsum("eab,pb->pea", inverse, ways)
    a, b = np.square(way).sum(-1), (start * way).sum(-1)
    c = np.square(start).sum(-1) - 1
    root = np.sqrt(np.maximum(b**2 - a * c, 0))
    inside = c < 0
    up = np.where(inside, (root - b) / a, 0).max(1)
    down = np.where(inside, (root + b) / a, 0).max(1)
    return up + down


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    # Much faster than np.cross on few vectors.
    after, before = [1, 2, 0], [2, 0, 1]
    return first[..., after] * second[..., before] - first[..., before] * second[..., after]
