"""Hypotheses of a crop in one compiled call; see proposals.run_pose_network.

The same formulas as PoseNet.decode's and proposals.run_pose_network's, which are the reference,
without the microseconds that every operation costs on a few numbers.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
import torch

from toftrack.compute import convolution_numba, rigid_numba
from toftrack.compute.compiling import called, compiled, entry_point, take
from toftrack.compute.rigid import PIVOT_M
from toftrack.compute.rigid_numba import pose_hand, rotation_vector
from toftrack.compute.threads import beside, run_shared
from toftrack.detector import crops, crops_numba, network, network_numba, proposals
from toftrack.detector.crops import CROP, CROP_M, crop_rotation
from toftrack.detector.crops_numba import read_crop
from toftrack.detector.network import (
    ANGLES,
    ERROR_M,
    JOINT_M,
    JOINTS,
    LEAST_ERROR_M,
    LEAST_SIGMA_M,
    LOG_SIZE,
    OFFSET_M,
    SIGMA_M,
    PoseNet,
    cube_rotations,
)
from toftrack.detector.network_numba import PackedPoseNet, pack_pose_net, pose_outputs
from toftrack.detector.proposals import DOUBT_M, KEPT, MIRROR, NetworkOutput, mean_hand
from toftrack.hand import overlap, overlap_numba
from toftrack.hand.overlap_numba import add_overlaps
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M
from toftrack.hand.skeleton import ANGLE_LIMITS

_SOURCES = (rigid_numba, overlap, overlap_numba, crops, crops_numba, network, network_numba)
_cached = entry_point(__file__, *(module.__file__ for module in (*_SOURCES, convolution_numba)))
_COMPILING = "detector: compiling its numba kernels (once, about 5 s)"
_ANCHORS = cube_rotations().double().numpy()
_LIMITS = np.array(ANGLE_LIMITS)
_PIVOT = np.array(PIVOT_M)
_EACH = 6 + ANGLES + 1 + 3 + 2
"""Numbers of a hypothesis: rotation, angles, size, pivot, chance, error."""
_CELLS = 16


def run_pose_network(
    pose: PoseNet, depth_m: np.ndarray, k: np.ndarray, centres_m: np.ndarray, side: str
) -> NetworkOutput:
    """See proposals.run_pose_network, which it is where the network is on another device."""
    if pose.anchors.device.type != "cpu":
        return proposals.run_pose_network(pose, depth_m, k, centres_m, side)
    task, out = _prepared(pose, depth_m, k, centres_m, side)
    if detect_at.signatures:
        run_shared(task, len(centres_m))
    else:
        called(detect_at, _COMPILING, *task.args)
    return _reported(out)


def start_pose_network(
    pose: PoseNet, depth_m: np.ndarray, k: np.ndarray, centres_m: np.ndarray, side: str
) -> Callable[[], NetworkOutput]:
    """The same, begun in another thread if there may be one; what is returned waits for it.

    That thread has nothing to do but the kernel, so that it hardly needs the interpreter's lock.
    """
    if pose.anchors.device.type != "cpu" or not detect_at.signatures:
        return functools.partial(run_pose_network, pose, depth_m, k, centres_m, side)
    task, out = _prepared(pose, depth_m, k, centres_m, side)
    wait = beside(task)

    def reported() -> NetworkOutput:
        wait()
        return _reported(out)

    return reported


def _reported(out: dict[str, np.ndarray]) -> NetworkOutput:
    return NetworkOutput(**{name: torch.from_numpy(array) for name, array in out.items()})


def _prepared(
    pose: PoseNet, depth_m: np.ndarray, k: np.ndarray, centres_m: np.ndarray, side: str
) -> tuple[functools.partial[None], dict[str, np.ndarray]]:
    """The kernel's call, and the arrays that it writes."""
    # Copies: numba compiles once more for arrays that must not be written to.
    centres, k = np.array(centres_m, np.float64).reshape(-1, 3), np.array(k, np.float64)
    left = side == "left"
    if left:
        k[0, 2] = depth_m.shape[1] - 1 - k[0, 2]
        centres = centres * MIRROR.numpy()
    rotations = np.stack([crop_rotation(centre) for centre in centres])
    out = _empty(len(centres))
    task = functools.partial(
        detect_at,
        np.ascontiguousarray(depth_m, np.float32),
        left,
        k,
        centres,
        rotations,
        _packed(pose),
        _mean_hand(side),
        tuple(out.values()),
        np.zeros(1, np.int64),
    )
    return task, out


@functools.lru_cache
def _mean_hand(side: str) -> tuple[np.ndarray, ...]:
    shape = mean_hand(side)
    parts = shape.base_frames, shape.base_m, shape.bone_lengths_m
    return tuple(part.double().numpy() for part in parts)


@functools.lru_cache(maxsize=2)
def _packed(pose: PoseNet) -> PackedPoseNet:
    return pack_pose_net(pose)


def _empty(count: int) -> dict[str, np.ndarray]:
    """Arrays of Look's fields, in their order."""
    shapes = {
        "pivot_m": (KEPT, 3),
        "rotvec": (KEPT, 3),
        "angles": (KEPT, ANGLES),
        "log_size": (KEPT,),
        "log_probability": (KEPT,),
        "error_m": (KEPT,),
        "joints_m": (KEPT, JOINTS, 3),
        "keypoints_m": (JOINTS, 3),
        "sigma_m": (JOINTS,),
        "present": (),
        "right": (),
    }
    return {name: np.empty((count, *shape), np.float32) for name, shape in shapes.items()}


@_cached
def detect_at(depth, mirror, k, centres, rotations, net, hand, out, counter):
    """Crops about centres (C, 3), turned by (C, 3, 3), through the network, into Look's arrays.

    mirror: the image is to be read as a mirror shows it; k and centres are those of the mirrored.
    net: PackedPoseNet.  hand: frames (5, 3, 3), places (5, 3) and bones (5, 3) of the mean one.
    counter: (1,) int64 crops taken, by threads that share them.
    """
    image = np.empty((3, CROP, CROP), np.float32)
    while True:
        c = take(counter)
        if c >= len(centres):
            break
        _crop(depth, mirror, k, centres[c], rotations[c], image)
        heads, keypoints = pose_outputs(image, net)
        _decode(heads, keypoints, image[0], rotations[c], centres[c], mirror, hand, c, out)


@compiled
def _crop(depth, mirror, k, centre, turn, image):
    """See crops.crop."""
    mapping, single, slope = np.empty((3, 3)), np.empty((3, 3), np.float32), np.empty(3, np.float32)
    distance = math.sqrt(centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2)
    focal, middle = 2 * CROP * distance / CROP_M, (2 * CROP - 1) / 2
    largest = 0.0
    for i in range(3):
        for j in range(3):
            mapping[i, j] = k[i, 0] * turn[0, j] + k[i, 1] * turn[1, j] + k[i, 2] * turn[2, j]
        # The crop's pinhole, mapped into the image: u ~ K R K_crop^-1 u_crop.
        mapping[i, 0] /= focal
        mapping[i, 1] /= focal
        mapping[i, 2] -= middle * (mapping[i, 0] + mapping[i, 1])
        for j in range(3):
            largest = max(largest, abs(mapping[i, j]))
    for i in range(3):
        for j in range(3):  # only the ratios count, and a large scale says infinity in float32
            single[i, j] = mapping[i, j] / largest
    slope[0], slope[1] = turn[2, 0] / focal, turn[2, 1] / focal
    slope[2] = turn[2, 2] - middle * (turn[2, 0] + turn[2, 1]) / focal
    scale = np.float32(2 / CROP_M)
    read_crop(depth, mirror, single, slope, scale, np.float32(distance), image)


@compiled
def _decode(heads, keypoints, depth, turn, centre, mirror, hand, c, out):
    """A crop's outputs decoded, see PoseNet.decode and proposals.run_pose_network."""
    _, _, _, log_size, _, _, _, joints, sigma, present, right = out
    present[c], right[c] = heads[len(_ANCHORS) * _EACH], heads[len(_ANCHORS) * _EACH + 1]
    _decode_hypotheses(heads, turn, centre, mirror, hand, c, out)
    _decode_keypoints(keypoints, depth, joints[c], sigma[c])
    for j in range(JOINTS):
        p = (joints[c, j, 0], joints[c, j, 1], joints[c, j, 2])
        _into_camera(p, turn, centre, mirror, joints[c, j])
    of_finger = np.zeros(5)
    length = DEFAULT_HAND_LENGTH_M * math.exp(log_size[c, 0])
    add_overlaps(joints[c], length, of_finger)
    for finger in range(5):
        doubt = DOUBT_M * min(of_finger[finger], 1.0)
        for joint in range(2 + 4 * finger, 5 + 4 * finger):
            sigma[c, joint] = math.sqrt(sigma[c, joint] ** 2 + doubt * doubt)


@compiled
def _decode_hypotheses(reported, turn, centre, mirror, hand, c, out):
    """The likeliest hypotheses of a crop, in their order."""
    pivot, rotvec, angles, log_size, log_probability, error, joints, _, _, _, _ = out
    count = len(_ANCHORS)
    chance = np.empty(count)
    for h in range(count):
        chance[h] = reported[h * _EACH + _EACH - 2]
    first, total = _largest(chance), 0.0
    top = chance[first]
    for h in range(count):
        total += math.exp(chance[h] - top)
    matrix, state = np.empty((3, 3)), np.zeros(27)
    frames, posed = np.empty((16, 3, 3)), np.empty((JOINTS, 3))
    for kept in range(KEPT):
        h = _largest(chance)
        log_probability[c, kept] = chance[h] - top - math.log(total)
        chance[h] = -np.inf
        one = reported[h * _EACH : (h + 1) * _EACH]
        _rotation(one, _ANCHORS[h], turn, matrix)
        turned = rotation_vector(_quaternion(matrix))
        sign = -1.0 if mirror else 1.0
        for i in range(3):
            state[3 + i] = turned[i] if i == 0 else sign * turned[i]
            rotvec[c, kept, i] = state[3 + i]
        for j in range(ANGLES):
            low, high = _LIMITS[j]
            state[6 + j] = low + (high - low) * _sigmoid(one[6 + j])
            angles[c, kept, j] = state[6 + j]
        log_size[c, kept] = LOG_SIZE * one[6 + ANGLES]
        p = one[7 + ANGLES : 10 + ANGLES]
        at = (OFFSET_M * p[0], OFFSET_M * p[1], OFFSET_M * p[2])
        _into_camera(at, turn, centre, mirror, pivot[c, kept])
        error[c, kept] = ERROR_M * _softplus(one[_EACH - 1]) + LEAST_ERROR_M
        pose_hand(state, hand[0], hand[1], hand[2], sign, frames, posed)
        size = math.exp(log_size[c, kept])
        for i in range(3):
            # A mirror changes nothing on the palm's middle line.
            middle = 0.0
            for k in range(3):
                middle += frames[0, i, k] * _PIVOT[k]
            for j in range(JOINTS):
                joints[c, kept, j, i] = pivot[c, kept, i] + size * (posed[j, i] - middle)


@compiled
def _largest(values):
    found = 0
    for i in range(len(values)):
        if values[i] > values[found]:
            found = i
    return found


@compiled
def _rotation(reported, anchor, turn, matrix):
    """turn G anchor, of the first two columns that are told G being made a rotation."""
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
def _quaternion(m):
    """Of a rotation matrix (3, 3), from its largest component on (Shepperd, 1978)."""
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    largest = 0
    for i in range(1, 3):
        if m[i, i] > m[largest, largest]:
            largest = i
    if trace > m[largest, largest]:
        w = math.sqrt(1 + trace) / 2
        s = 1 / (4 * w)
        return (m[2, 1] - m[1, 2]) * s, (m[0, 2] - m[2, 0]) * s, (m[1, 0] - m[0, 1]) * s, w
    i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
    a = math.sqrt(max(1 + m[i, i] - m[j, j] - m[k, k], 1e-12)) / 2
    s = 1 / (4 * a)
    b, d, w = (m[i, j] + m[j, i]) * s, (m[i, k] + m[k, i]) * s, (m[k, j] - m[j, k]) * s
    if i == 0:
        return a, b, d, w
    if i == 1:
        return d, a, b, w
    return b, d, a, w


@compiled
def _into_camera(p, turn, centre, mirror, out):
    """A point of a crop's frame, about its centre, in the camera's, mirrored back if need be."""
    for i in range(3):
        value = turn[i, 0] * p[0] + turn[i, 1] * p[1] + turn[i, 2] * p[2] + centre[i]
        out[i] = -value if mirror and i == 0 else value


@compiled
def _decode_keypoints(keypoints, depth, joints, sigma):
    """Weighted means of the cells' keypoints (16, 16, 5 * JOINTS), see PoseNet._joints."""
    top, total = np.full(JOINTS, -np.inf, np.float32), np.zeros(JOINTS)
    sums, spread = np.zeros((3, JOINTS)), np.zeros(JOINTS)
    for row in range(_CELLS):
        for column in range(_CELLS):
            for j in range(JOINTS):
                top[j] = max(top[j], keypoints[row, column, j])
    block = CROP // _CELLS
    for row in range(_CELLS):
        for column in range(_CELLS):
            # Depth is predicted about the surface that the cell sees.
            seen = 0.0
            for i in range(block):
                for k in range(block):
                    seen += depth[block * row + i, block * column + k]
            seen *= CROP_M / 2 / block**2
            across, down = _cell(column), _cell(row)
            keypoint = keypoints[row, column]
            for j in range(JOINTS):
                weight = math.exp(keypoint[j] - top[j])
                total[j] += weight
                sums[0, j] += weight * (across + JOINT_M * keypoint[JOINTS + j])
                sums[1, j] += weight * (down + JOINT_M * keypoint[2 * JOINTS + j])
                sums[2, j] += weight * (seen + JOINT_M * keypoint[3 * JOINTS + j])
                spread[j] += weight * keypoint[4 * JOINTS + j]
    for j in range(JOINTS):
        for i in range(3):
            joints[j, i] = sums[i, j] / total[j]
        sigma[j] = SIGMA_M * _softplus(spread[j] / total[j]) + LEAST_SIGMA_M


@compiled
def _cell(number):
    """Where the middle of a cell is, metres from the crop's."""
    return ((number + 0.5) / _CELLS - 0.5) * CROP_M


@compiled
def _sigmoid(x):
    return 1 / (1 + math.exp(-x))


@compiled
def _softplus(x):
    return x + math.log1p(math.exp(-x)) if x > 0 else math.log1p(math.exp(x))
