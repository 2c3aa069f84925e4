"""What the pose network says of a crop, in compiled code; see PoseNet.decode, the reference."""

from __future__ import annotations

import math

import numpy as np

from toftrack.compute.compiling import compiled, shared_entry_point
from toftrack.compute.rigid import PIVOT_M
from toftrack.compute.rigid_numba import pose_hand, quaternion_of, rotation_vector
from toftrack.detector.crops import CROP, CROP_M
from toftrack.detector.network import (
    ANGLES,
    CELLS,
    EACH,
    ERROR_M,
    JOINT_M,
    JOINTS,
    LEAST_ERROR_M,
    LEAST_SIGMA_M,
    LOG_SIZE,
    OFFSET_M,
    SIGMA_M,
    cube_rotations,
)
from toftrack.hand.skeleton import ANGLE_LIMITS

KEPT = 12
"""Hypotheses of a crop that are used further."""
_ANCHORS = cube_rotations().double().numpy()
_LIMITS = np.array(ANGLE_LIMITS)
_PIVOT = np.array(PIVOT_M)


@shared_entry_point
def decode_at(heads, keypoints, depth, turn, centre, mirror, hand, out):
    """What the network's outputs for a crop mean, see PoseNet.decode.

    heads: (REPORTED,).  keypoints: (5 * JOINTS, CELLS, CELLS).  depth: (CROP, CROP), the first
    channel.  turn, centre, mirror: as of crop_at.
    hand: frames (5, 3, 3), places (5, 3) and bones (5, 3) of the mean one.
    out: written: proposals' arrays of hypotheses; keypoints (21, 3), their deviations (21,); log
    odds (2,) of a hand, and of the side that was looked for.
    """
    joints, sigma, odds = out[7:]
    odds[0], odds[1] = heads[len(_ANCHORS) * EACH], heads[len(_ANCHORS) * EACH + 1]
    _decode_hypotheses(heads, turn, centre, mirror, hand, out)
    _decode_keypoints(keypoints, depth, joints, sigma)
    for j in range(JOINTS):
        p = joints[j]
        p64 = np.float64(p[0]), np.float64(p[1]), np.float64(p[2])
        _into_camera(p64, turn, centre, mirror, p)


@compiled
def _decode_hypotheses(reported, turn, centre, mirror, hand, out):
    """The likeliest hypotheses of a crop, in their order."""
    pivot, rotvec, angles, joints, log_size, log_probability, error, _, _, _ = out
    count = len(_ANCHORS)
    chance = np.empty(count, np.float64)
    for h in range(count):
        chance[h] = reported[h * EACH + EACH - 2]
    first, total = _largest(chance), 0.0
    top = chance[first]
    for h in range(count):
        total += math.exp(chance[h] - top)
    matrix, state = np.empty((3, 3), np.float64), np.zeros(27, np.float64)
    frames, posed = np.empty((16, 3, 3), np.float64), np.empty((JOINTS, 3), np.float64)
    for kept in range(KEPT):
        h = _largest(chance)
        log_probability[kept] = chance[h] - top - math.log(total)
        chance[h] = -np.inf
        one = reported[h * EACH : (h + 1) * EACH]
        _rotation(one, _ANCHORS[h], turn, matrix)
        turned = rotation_vector(quaternion_of(matrix))
        sign = -1.0 if mirror else 1.0
        for i in range(3):
            state[3 + i] = turned[i] if i == 0 else sign * turned[i]
            rotvec[kept, i] = state[3 + i]
        for j in range(ANGLES):
            low, high = _LIMITS[j]
            state[6 + j] = low + (high - low) / (1 + math.exp(-one[6 + j]))
            angles[kept, j] = state[6 + j]
        log_size[kept] = LOG_SIZE * one[6 + ANGLES]
        x, y, z = one[7 + ANGLES], one[8 + ANGLES], one[9 + ANGLES]
        at = (OFFSET_M * x, OFFSET_M * y, OFFSET_M * z)
        _into_camera(at, turn, centre, mirror, pivot[kept])
        error[kept] = ERROR_M * _softplus(one[EACH - 1]) + LEAST_ERROR_M
        pose_hand(state, hand[0], hand[1], hand[2], sign, frames, posed)
        size = math.exp(log_size[kept])
        for i in range(3):
            # A mirror changes nothing on the palm's middle line.
            middle = 0.0
            for k in range(3):
                middle += frames[0, i, k] * _PIVOT[k]
            for j in range(JOINTS):
                joints[kept, j, i] = pivot[kept, i] + size * (posed[j, i] - middle)


@compiled
def _largest(values):
    """The index of the largest value."""
    found = 0
    for i in range(len(values)):
        if values[i] > values[found]:
            found = i
    return found


@compiled
def _rotation(reported, anchor, turn, matrix):
    """Write turn @ G @ anchor into `matrix`, where G is the rotation that Gram-Schmidt makes of the
    two columns `reported`.
    """
    x = (1 + 0.5 * reported[0], 0.5 * reported[1], 0.5 * reported[2])
    y = (0.5 * reported[3], 1 + 0.5 * reported[4], 0.5 * reported[5])
    norm = math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    x = (x[0] / norm, x[1] / norm, x[2] / norm)
    along = x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
    y = (y[0] - along * x[0], y[1] - along * x[1], y[2] - along * x[2])
    norm = math.sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2])
    y = (y[0] / norm, y[1] / norm, y[2] / norm)
    z = (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])
    for i in range(3):
        a = turn[i, 0] * x[0] + turn[i, 1] * x[1] + turn[i, 2] * x[2]
        b = turn[i, 0] * y[0] + turn[i, 1] * y[1] + turn[i, 2] * y[2]
        d = turn[i, 0] * z[0] + turn[i, 1] * z[1] + turn[i, 2] * z[2]
        for j in range(3):
            matrix[i, j] = a * anchor[0, j] + b * anchor[1, j] + d * anchor[2, j]


@compiled
def _into_camera(p, turn, centre, mirror, out):
    """A point of a crop's frame, about its centre, in the camera's, mirrored back if need be."""
    for i in range(3):
        value = turn[i, 0] * p[0] + turn[i, 1] * p[1] + turn[i, 2] * p[2] + centre[i]
        out[i] = -value if mirror and i == 0 else value


@compiled
def _decode_keypoints(keypoints, depth, joints, sigma):
    """Weighted means of the cells' keypoints (5 * JOINTS, 16, 16), see PoseNet._joints."""
    # Depth is predicted about the surface that the cell sees.
    seen, block = np.zeros((CELLS, CELLS), np.float64), CROP // CELLS
    for row in range(CROP):
        for column in range(CROP):
            seen[row // block, column // block] += depth[row, column]
    for j in range(JOINTS):
        weights, x, y = keypoints[j], keypoints[JOINTS + j], keypoints[2 * JOINTS + j]
        z, deviation = keypoints[3 * JOINTS + j], keypoints[4 * JOINTS + j]
        top = weights[0, 0]
        for row in range(CELLS):
            for column in range(CELLS):
                top = max(top, weights[row, column])
        total, a, b, d, spread = 0.0, 0.0, 0.0, 0.0, 0.0
        for row in range(CELLS):
            for column in range(CELLS):
                weight = math.exp(weights[row, column] - top)
                total += weight
                a += weight * (_cell(column) + JOINT_M * x[row, column])
                b += weight * (_cell(row) + JOINT_M * y[row, column])
                surface = seen[row, column] * (CROP_M / 2 / (block * block))
                d += weight * (surface + JOINT_M * z[row, column])
                spread += weight * deviation[row, column]
        joints[j, 0], joints[j, 1], joints[j, 2] = a / total, b / total, d / total
        sigma[j] = SIGMA_M * _softplus(spread / total) + LEAST_SIGMA_M


@compiled
def _cell(number):
    """Where the middle of a cell is, metres from the crop's."""
    return ((number + 0.5) / CELLS - 0.5) * CROP_M


@compiled
def _softplus(x):
    """Of a number: log(1 + exp(x))."""
    return x + math.log1p(math.exp(-x)) if x > 0 else math.log1p(math.exp(x))
