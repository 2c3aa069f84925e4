"""The hand of an estimate in other programs' conventions, beside the tracker's own."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from toftrack.compute.compiling import compiled, entry_point
from toftrack.compute.rigid_numba import pose_hand, quaternion_of
from toftrack.estimate import Estimate
from toftrack.hand.openxr import OpenXRHand, OpenXRRig, openxr_hand, openxr_rig
from toftrack.hand.shape import HandShape

_DECIMALS = 6
"""Micrometres: so many are less than anybody sees, and a line is half as long as with all."""


def in_all_conventions(
    estimate: Estimate, shape: HandShape, k: np.ndarray, size_px: tuple[int, int]
) -> Estimate:
    """The estimate with landmarks and the joints of OpenXR, which follow from its other fields.

    shape: the hand of the estimate.  k: (3, 3) intrinsics, pixels.  size_px: width, height.
    """
    known = np.isfinite(estimate.joints_m).all() and np.isfinite(estimate.state).all()
    place = openxr_hand_compiled if known else openxr_hand
    hand = place(estimate.joints_m, estimate.state, openxr_rig(shape))
    return replace(
        estimate,
        landmarks=np.round(image_landmarks(estimate.joints_m, k, size_px), _DECIMALS),
        openxr_position_m=np.round(hand.position_m, _DECIMALS),
        openxr_orientation=np.round(hand.orientation, _DECIMALS),
        openxr_radius_m=np.round(hand.radius_m, _DECIMALS),
    )


def image_landmarks(joints_m: np.ndarray, k: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Joints as MediaPipe's normalised landmarks, (..., 21, 3) metres to (..., 21, 3) without unit.

    x, y: parts of the image's width and height, 0 at its left and upper edge, 1 at the others; of
    the undistorted image, and outside of 0..1 where a joint is outside of it.
    z: depth beyond the wrist's, negative where nearer to the camera, in parts of the image's width
    as a length at the wrist's distance is.
    NaN where a joint has no image.

    k: (3, 3) intrinsics in pixels, whose centres lie at whole numbers.  size_px: width, height.
    """
    joints = np.asarray(joints_m, np.float64)
    width, height = size_px
    depth = np.where(joints[..., 2] > 0, joints[..., 2], np.nan)
    u = joints[..., 0] / depth * k[0, 0] + k[0, 2]
    v = joints[..., 1] / depth * k[1, 1] + k[1, 2]
    wrist = depth[..., :1]
    beyond = (depth - wrist) / wrist * (k[0, 0] / width)
    return np.stack(((u + 0.5) / width, (v + 0.5) / height, beyond), -1)


def openxr_hand_compiled(joints_m: np.ndarray, state: np.ndarray, rig: OpenXRRig) -> OpenXRHand:
    """See openxr.openxr_hand; one hand: joints_m (21, 3), state (27,), both without NaN."""
    position, orientation = np.empty((26, 3)), np.empty((26, 4))
    joints, state = np.asarray(joints_m, np.float64), np.asarray(state, np.float64)
    mirror = -1.0 if rig.mirrored else 1.0
    place(joints, state, *rig[:3], mirror, position, orientation)
    return OpenXRHand(position, orientation, rig.radius_m)


@entry_point
def place(joints, state, base_frames, metacarpals, radius, mirror, position, orientation):
    """joints: (21, 3), state: (27,), and the rig's arrays; the last two are written, all float64.

    mirror: -1 for a left hand, else 1.
    """
    frames, none = np.empty((16, 3, 3), np.float64), np.zeros((21, 3), np.float64)
    pose_hand(state, base_frames, none[:5], none[:5], mirror, frames, none)
    way, nail, start = np.empty(3, np.float64), np.empty(3, np.float64), np.empty(3, np.float64)
    axes = np.empty((3, 3), np.float64)
    for i in range(3):
        position[1, i] = joints[0, i]
    for finger in range(5):
        first = 2 if finger == 0 else 2 + 5 * finger  # where its first phalanx begins
        if finger > 0:
            for i in range(3):
                start[i] = joints[0, i]
                for k in range(3):
                    start[i] += frames[0, i, k] * metacarpals[finger - 1, k]
                position[first - 1, i] = start[i]
                way[i] = joints[1 + 4 * finger, i] - start[i]
                nail[i] = 0.0
                for k in range(3):
                    nail[i] += frames[0, i, k] * base_frames[finger, k, 0]
            turn(way, nail, mirror, axes, orientation[first - 1])
        for bone in range(3):
            frame = frames[1 + 3 * finger + bone]
            for i in range(3):
                position[first + bone, i] = joints[1 + 4 * finger + bone, i]
                way[i] = -frame[i, 1]
                nail[i] = frame[i, 0]
            turn(way, nail, mirror, axes, orientation[first + bone])
        for i in range(3):
            inset = radius[first + 3] * way[i]
            position[first + 3, i] = joints[4 + 4 * finger, i] - inset
        for i in range(4):
            orientation[first + 3, i] = orientation[first + 2, i]
    for i in range(3):
        position[0, i] = 0.5 * (position[11, i] + position[12, i])
        way[i] = position[11, i] - position[1, i]
        nail[i] = frames[0, i, 0]
    turn(way, nail, mirror, axes, orientation[1])
    for i in range(4):
        orientation[0, i] = orientation[11, i]
    for joint in range(26):
        for i in range(1, 3):
            position[joint, i] = -position[joint, i]


@compiled
def turn(way, hinge, mirror, axes, out):
    """Quaternion (4,) x y z w of a bone's axes in the world: its direction, and the axis about
    which it bends, both (3,) in the camera's frame.
    """
    length = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
    # The world's y and z are the camera's, turned round.
    d0, d1, d2 = way[0] / length, -way[1] / length, -way[2] / length
    h0, h1, h2 = mirror * hinge[0], -mirror * hinge[1], -mirror * hinge[2]
    y0, y1, y2 = d1 * h2 - d2 * h1, d2 * h0 - d0 * h2, d0 * h1 - d1 * h0
    length = math.sqrt(y0 * y0 + y1 * y1 + y2 * y2)
    y0, y1, y2 = y0 / length, y1 / length, y2 / length
    axes[0, 0], axes[1, 0], axes[2, 0] = d1 * y2 - d2 * y1, d2 * y0 - d0 * y2, d0 * y1 - d1 * y0
    axes[0, 1], axes[1, 1], axes[2, 1] = y0, y1, y2
    axes[0, 2], axes[1, 2], axes[2, 2] = -d0, -d1, -d2
    q = quaternion_of(axes)
    for i in range(4):
        out[i] = -q[i] if q[3] < 0 else q[i]
