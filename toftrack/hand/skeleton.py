"""The kinematic chain of the hand: 27 degrees of freedom to joint transforms (paper, section 2.2).

Hand frame (metres): origin at the wrist joint, and for a right hand held up with its palm towards
the camera and its fingers up, the axes are the camera's: x towards the thumb, y towards the
forearm, z out of the back of the hand. A left hand is the mirror image, x -> -x in the hand frame.

The 21 joint angles are five for the thumb (carpometacarpal abduction and flexion,
metacarpophalangeal abduction and flexion, interphalangeal flexion) and four for each other finger
(metacarpophalangeal abduction and flexion, proximal and distal interphalangeal flexion).
Positive flexion curls towards the palm, positive abduction turns towards the thumb's side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.rotations import rotvec_to_rotmat
from toftrack.compute.transfer import table
from toftrack.hand.shape import HandShape

FINGERS = ("thumb", "index", "middle", "ring", "little")

JOINT_NAMES: tuple[str, ...] = (
    "wrist",
    *(f"thumb_{joint}" for joint in ("cmc", "mcp", "ip", "tip")),
    *(f"{finger}_{joint}" for finger in FINGERS[1:] for joint in ("mcp", "pip", "dip", "tip")),
)
"""The 21 joints in the order of every file: wrist, then four for each finger. MediaPipe's order."""
JOINT_PARENTS: tuple[int, ...] = (-1, *(0 if j % 4 == 0 else j for j in range(20)))
"""Which joint each one hangs on; -1 for the wrist."""

ANGLE_NAMES: tuple[str, ...] = (
    "thumb_cmc_abduction",
    "thumb_cmc_flexion",
    "thumb_mcp_abduction",
    "thumb_mcp_flexion",
    "thumb_ip_flexion",
    *(
        f"{finger}_{angle}"
        for finger in FINGERS[1:]
        for angle in ("mcp_abduction", "mcp_flexion", "pip_flexion", "dip_flexion")
    ),
)
"""The 21 joint angles in the order of every pose vector."""

# Range of motion in degrees, rounded outwards from the clinical ranges of the American Academy of
# Orthopaedic Surgeons (Joint Motion, 1965) as tabulated by Lin, Wu, Huang (Workshop on Human
# Motion,
# 2000). The thumb's ranges are about the rest pose of HandShape, not the anatomical zero.
_THUMB_LIMITS = ((-35, 45), (-25, 50), (-25, 25), (-25, 70), (-25, 90))
_FINGER_LIMITS = ((-25, 25), (-30, 95), (-10, 120), (-10, 90))

ANGLE_LIMITS: tuple[tuple[float, float], ...] = tuple(
    (math.radians(low), math.radians(high)) for low, high in (*_THUMB_LIMITS, *_FINGER_LIMITS * 4)
)
"""(21, 2) lower and upper joint limits, radians."""

# Every finger is a chain of three joints with the slots (abduction, flexion, abduction, flexion,
# flexion): the thumb uses all five, the others have no abduction at their second joint.
CHAIN_SLOTS = (*range(5), *(5 * f + s for f in range(1, 5) for s in (0, 1, 3, 4)))
"""Where each of the 21 angles goes in the (5 fingers x 5 slots) layout of the chain."""
SLOT_BONES = [0, 0, 1, 1, 2]
"""The bone of a finger that each of its slots is the first to turn, about an axis through its
proximal end: the z axis of the bone before (of the rest frame), or its own x axis."""
_BEFORE = np.array([-1, *(4 * finger + joint for finger in range(5) for joint in range(4))])
_FIRST = np.array([4 * (slot // 5) + SLOT_BONES[slot % 5] for slot in CHAIN_SLOTS])
JOINT_MOVES = (_BEFORE[:, None] // 4 == _FIRST // 4) & (_BEFORE[:, None] > _FIRST)
"""(21, 21) which angles move each joint: those that turn a bone of its finger before it."""


class HandPose(NamedTuple):
    """Transforms of a batch of hands in the camera frame.

    joints_m: (N, 21, 3) in the order of JOINT_NAMES.
    frames: (N, 16, 3, 3) rotations (hand frame first, then the 15 bones finger by finger, each
        with its distal end along -y); of determinant -1 for left hands.
    origins_m: (N, 16, 3) the wrist and the proximal end of each bone.
    """

    joints_m: Tensor
    frames: Tensor
    origins_m: Tensor


def _turn(abduction: Tensor, flexion: Tensor) -> Tensor:
    """exp([z] abduction) exp([x] flexion) in closed form, (...) and (...) to (..., 3, 3)."""
    ca, sa, cf, sf = abduction.cos(), abduction.sin(), flexion.cos(), flexion.sin()
    zero = torch.zeros_like(ca)
    rows = (ca, -sa * cf, sa * sf, sa, ca * cf, -ca * sf, zero, sf, cf)
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def forward_kinematics(state: Tensor, shape: HandShape) -> HandPose:
    """State vectors to joints and bone frames, one batched product per joint depth.

    Algorithm, with X a point of bone k of a finger in that bone's frame:
      1. R_1 = B exp([z] a_1) exp([x] f_1), the base frame B of the finger in the palm;
         R_2 = R_1 exp([z] a_2) exp([x] f_2);  R_3 = R_2 exp([x] f_3);
      2. o_1 is the finger's base in the palm, o_{k+1} = o_k - l_k R_k y;
      3. X_hand = R_k X + o_k;  X_camera = R M X_hand + t, with M = diag(-1, 1, 1) for a left hand.

    state: (N, 27) translation (3, m), rotation vector (3, rad), joint angles (21, rad).
    shape: sizes on the same device and of the same dtype.
    Returns a HandPose.
    """
    n = state.shape[0]
    slots = state.new_zeros(n, 25)
    slots[:, table(CHAIN_SLOTS, torch.int64, state.device)] = state[:, 6:]
    abduction_1, flexion_1, abduction_2, flexion_2, flexion_3 = slots.view(n, 5, 5).unbind(-1)

    r1 = shape.base_frames @ _turn(abduction_1, flexion_1)
    r2 = r1 @ _turn(abduction_2, flexion_2)
    r3 = r2 @ _turn(torch.zeros_like(flexion_3), flexion_3)
    local = torch.stack((r1, r2, r3), 2)  # (N, 5, 3 bones, 3, 3)

    steps = -shape.bone_lengths_m[..., None] * local[..., 1]
    base = shape.base_m.expand(n, 5, 3)[:, :, None]
    points = torch.cat((base, base + steps.cumsum(2)), 2)  # (N, 5, 4, 3)

    rotation = rotvec_to_rotmat(state[:, 3:6])
    if shape.side == "left":
        rotation = rotation * table((-1.0, 1.0, 1.0), rotation.dtype, rotation.device)
    translation = state[:, None, :3]
    joints = points.flatten(1, 2) @ rotation.mT + translation
    frames = torch.cat((rotation[:, None], rotation[:, None] @ local.flatten(1, 2)), 1)
    proximal = joints.unflatten(1, (5, 4))[:, :, :3].flatten(1, 2)
    return HandPose(
        joints_m=torch.cat((translation, joints), 1),
        frames=frames,
        origins_m=torch.cat((translation, proximal), 1),
    )
