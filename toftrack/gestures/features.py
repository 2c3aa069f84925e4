"""What a gesture is recognised by: thirteen numbers of a hand's pose, whichever way it is turned.

Ten are sums of joint angles, which a depth image determines better than the angles themselves: of
the thumb the abduction and the total flexion; of each other finger the total flexion, and how much
more of it the two outer joints have than the knuckle. Three are distances in units of the palm
(wrist to the middle finger's knuckle), since where the tips lie says more than single angles do:
how far the thumb *reaches* away from the little finger's knuckle (0.6 .. 0.9 folded over palm or
fist, 1.0 beside the index finger, 1.3 .. 1.7 stretched away), its *gap* to the index finger's tip,
and how far index and middle fingertips are *apart* (0.25 side by side, 0.5 in a V). The fingers'
abduction counts nowhere else.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from toftrack.compute.compiling import entry_point
from toftrack.compute.rigid_numba import distance
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, ANGLE_NAMES, JOINT_NAMES, forward_kinematics

THUMB_ANGLES = 5
THUMB_ABDUCTION, THUMB_FLEXION = 0, 1
FLEXION, SPLIT = slice(2, 6), slice(6, 10)
REACH, GAP, APART = 10, 11, 12
COUNT = 13
"""Where each feature stands; the fingers from the index to the little one."""

_DISTANCE_RANGES = (1.3, 2.0, 1.6)
"""About from the least to the largest of the three distances of common poses, palm lengths."""
_WRIST, _MIDDLE, _LITTLE = (JOINT_NAMES.index(n) for n in ("wrist", "middle_mcp", "little_mcp"))
_THUMB_TIP, _INDEX_TIP, _MIDDLE_TIP = (
    JOINT_NAMES.index(f"{finger}_tip") for finger in ("thumb", "index", "middle")
)
_DISTANCES = (_THUMB_TIP, _LITTLE), (_THUMB_TIP, _INDEX_TIP), (_INDEX_TIP, _MIDDLE_TIP)
SUMS = np.zeros((REACH, len(ANGLE_NAMES)))
"""(10, 21): what is added up of the angles."""
_EVERY_JOINT = np.ones(len(JOINT_NAMES), bool)
_JOINTS = np.zeros((COUNT, len(JOINT_NAMES)), bool)
"""(13, 21): of which joints each feature speaks."""
SUMS[THUMB_ABDUCTION, 0] = 1.0
SUMS[THUMB_FLEXION, [1, 3, 4]] = 1.0
_JOINTS[[THUMB_ABDUCTION, THUMB_FLEXION], 1:5] = True
for _finger in range(4):
    _both = [FLEXION.start + _finger, SPLIT.start + _finger]
    _knuckle = THUMB_ANGLES + 4 * _finger + 1
    SUMS[_both, _knuckle] = 1.0, -1.0
    SUMS[_both, _knuckle + 1 : _knuckle + 3] = 1.0
    _JOINTS[_both, 5 + 4 * _finger : 9 + 4 * _finger] = True
for _feature, _pair in zip((REACH, GAP, APART), _DISTANCES, strict=True):
    _JOINTS[_feature, list(_pair)] = True  # their unit, the palm, is rigid
RANGES = np.append(np.abs(SUMS) @ np.diff(ANGLE_LIMITS)[:, 0], _DISTANCE_RANGES)
"""(13,) rad and palm lengths, from the least to the largest value within the joint limits."""


def features(
    angles_rad: np.ndarray, joints_m: np.ndarray, joint_ok: np.ndarray | None = None
) -> np.ndarray:
    """(13,) of one hand: rad, and palm lengths; NaN where one of a feature's joints is not ok.

    angles_rad: (21,) float64.  joints_m: (21, 3) float64 of the same pose, in any frame.
    joint_ok: (21,) bool; None = all are.
    """
    values = np.empty(COUNT)
    describe(angles_rad, joints_m, _EVERY_JOINT if joint_ok is None else joint_ok, values)
    return values


@entry_point
def describe(angles, joints, ok, values):
    """See features; into `values` (13,)."""
    for n in range(REACH):
        values[n] = 0.0
        for i in range(len(angles)):
            values[n] += SUMS[n, i] * angles[i]
    palm = distance(joints[_MIDDLE], joints[_WRIST])
    for n in range(len(_DISTANCES)):
        first, second = _DISTANCES[n]
        values[REACH + n] = distance(joints[first], joints[second]) / palm
    for n in range(len(values)):
        for joint in range(len(joints)):
            if _JOINTS[n, joint] and not ok[joint]:
                values[n] = np.nan


def features_of_angles(angles_rad: np.ndarray) -> np.ndarray:
    """(13,) of the mean adult hand in a pose; NaN where an angle that is needed is NaN.

    angles_rad: (21,), NaN where an angle does not matter.
    """
    state = torch.zeros(1, 6 + len(ANGLE_NAMES))
    state[0, 6:] = torch.from_numpy(np.nan_to_num(angles_rad)).float()
    joints = forward_kinematics(state, default_hand_shape()).joints_m[0].numpy()
    found = features(np.nan_to_num(angles_rad), joints.astype(np.float64))
    unknown = np.isnan(angles_rad)
    thumb, index, middle = unknown[:THUMB_ANGLES], unknown[5:9], unknown[9:13]
    tips = thumb.any(), thumb.any() or index.any(), index.any() or middle.any()
    found[np.append((np.abs(SUMS) @ unknown) > 0, tips)] = math.nan
    return found
