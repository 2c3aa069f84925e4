"""Compiled scalar geometry on the CPU: rotations, tangent offsets of particles, one hand's pose.

The same formulas as in rigid.py and hand/skeleton.py, without the microseconds that every eager
operation costs on a few numbers. Quaternions are (x, y, z, w); everything is computed in float64
but latent coordinates, which are float32.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.compiling import compiled, entry_point
from toftrack.compute.rigid import LEAST_WIDTH, PIVOT_M, Motions

_PIVOT = np.array(PIVOT_M)
_LEAST_WIDTH = np.float32(LEAST_WIDTH)
_SQUARINGS = 24
"""So often is a matrix squared of which only the main axis is to be left."""


@compiled
def quaternion(a, b, c):
    """Of a rotation vector, radians."""
    square = a * a + b * b + c * c
    angle = math.sqrt(square)
    # sin(angle / 2) / angle
    factor = math.sin(0.5 * angle) / angle if angle > 1e-6 else 0.5 - square / 48
    return factor * a, factor * b, factor * c, math.cos(0.5 * angle)


@compiled
def quaternion_of(m):
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
def product(p, q):
    """Of two quaternions: first q turns, then p."""
    return (
        p[3] * q[0] + p[0] * q[3] + p[1] * q[2] - p[2] * q[1],
        p[3] * q[1] - p[0] * q[2] + p[1] * q[3] + p[2] * q[0],
        p[3] * q[2] + p[0] * q[1] - p[1] * q[0] + p[2] * q[3],
        p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2],
    )


@compiled
def rotation_vector(q):
    """Of a unit quaternion, radians, of length 0 .. pi."""
    sign = -1.0 if q[3] < 0 else 1.0
    sine = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    # At a small angle, 2 atan(sine / cosine) / sine is 2 / cosine.
    factor = 2 * math.atan2(sine, sign * q[3]) / sine if sine > 1e-9 else 2.0
    factor *= sign
    return factor * q[0], factor * q[1], factor * q[2]


@compiled
def turned(q, x, y, z):
    """A vector turned by a unit quaternion."""
    a, b, c = q[1] * z - q[2] * y, q[2] * x - q[0] * z, q[0] * y - q[1] * x
    return (
        x + 2 * (q[3] * a + q[1] * c - q[2] * b),
        y + 2 * (q[3] * b + q[2] * a - q[0] * c),
        z + 2 * (q[3] * c + q[0] * b - q[1] * a),
    )


@compiled
def distance(a, b):
    """Of two points (3,)."""
    x, y, z = np.float64(a[0]) - b[0], np.float64(a[1]) - b[1], np.float64(a[2]) - b[2]
    return math.sqrt(x * x + y * y + z * z)


@compiled
def _moved(r, t, pivot, out):
    """One row of compose_rows."""
    before = quaternion(np.float64(r[3]), np.float64(r[4]), np.float64(r[5]))
    turn = quaternion(np.float64(t[3]), np.float64(t[4]), np.float64(t[5]))
    after = product(turn, before)
    old = turned(before, pivot[0], pivot[1], pivot[2])
    new = turned(after, pivot[0], pivot[1], pivot[2])
    vector = rotation_vector(after)
    for j in range(3):
        out[j] = r[j] + old[j] + t[j] - new[j]
        out[3 + j] = vector[j]
    for j in range(6, len(out)):
        out[j] = r[j] + t[j]


@entry_point
def compose_rows(reference, tangent, pivot, out):
    """See rigid.compose; reference, tangent, out: (N or 1, 6 + d) float32.  pivot: (3,) float64."""
    left, right = min(len(reference) - 1, 1), min(len(tangent) - 1, 1)
    for i in range(len(out)):
        _moved(reference[left * i], tangent[right * i], pivot, out[i])


@entry_point
def redraw_rows(particles, weights, positions, tangents, lower, upper, folds, pivot, out):
    """See rigid.redraw; particles: (M, 6 + d), tangents, out: (n, 6 + d), bounds: (d,), float32.

    weights: (M,), positions: (n,), pivot: (3,) float64.  folds: outside of the bounds, coordinates
    are folded back instead of truncated.
    """
    total, most = 0.0, 0
    for row in range(len(weights)):
        total += weights[row]
        most = row if weights[row] > 0 else most  # beyond it, only a rounding lies
    taken, reached = 0, weights[0]
    for i in range(len(out)):
        while taken < most and reached <= positions[i] * total:
            taken += 1
            reached += weights[taken]
        _moved(particles[taken], tangents[i], pivot, out[i])
        for j in range(len(lower)):
            least, latent = lower[j], out[i, 6 + j]
            if folds:
                there_and_back = max(np.float32(2) * (upper[j] - least), _LEAST_WIDTH)
                folded = (latent - least) % there_and_back
                out[i, 6 + j] = least + min(folded, there_and_back - folded)
            else:
                out[i, 6 + j] = min(max(latent, least), upper[j])


@entry_point
def difference_rows(particles, reference, pivot, out):
    """See rigid.difference; particles, out: (N, 6 + d), reference: (1, 6 + d), float32."""
    r = reference[0]
    before = quaternion(np.float64(r[3]), np.float64(r[4]), np.float64(r[5]))
    old = turned(before, pivot[0], pivot[1], pivot[2])
    back = (-before[0], -before[1], -before[2], before[3])
    for i in range(len(out)):
        p = particles[i]
        after = quaternion(np.float64(p[3]), np.float64(p[4]), np.float64(p[5]))
        new = turned(after, pivot[0], pivot[1], pivot[2])
        vector = rotation_vector(product(after, back))
        for j in range(3):
            out[i, j] = p[j] + new[j] - r[j] - old[j]
            out[i, 3 + j] = vector[j]
        for j in range(6, out.shape[1]):
            out[i, j] = p[j] - r[j]


@entry_point
def mean_row(particles, weights, out):
    """See rigid.mean; particles: (N, 6 + d) float32, weights: (N,) float64, out: (6 + d,)."""
    sums = np.zeros(len(out), np.float64)
    scatter, square = np.zeros((4, 4), np.float64), np.empty((4, 4), np.float64)
    for row in range(len(weights)):
        p, weight = particles[row], weights[row]
        q = quaternion(np.float64(p[3]), np.float64(p[4]), np.float64(p[5]))
        for i in range(4):
            for j in range(4):
                scatter[i, j] += weight * q[i] * q[j]
        for j in range(len(out)):
            sums[j] += weight * p[j]
    # A column of a high power is along the main axis, which is the mean rotation's quaternion.
    for _ in range(_SQUARINGS):
        trace = scatter[0, 0] + scatter[1, 1] + scatter[2, 2] + scatter[3, 3]
        for i in range(4):
            for j in range(4):
                square[i, j] = 0.0
                for k in range(4):
                    square[i, j] += scatter[i, k] * scatter[k, j] / (trace * trace)
        scatter, square = square, scatter
    most = 0
    for i in range(4):
        most = i if scatter[i, i] > scatter[most, most] else most
    x, y, z, w = scatter[most, 0], scatter[most, 1], scatter[most, 2], scatter[most, 3]
    size = math.sqrt(x * x + y * y + z * z + w * w)
    vector = rotation_vector((x / size, y / size, z / size, w / size))
    for j in range(len(out)):
        out[j] = sums[j] if j < 3 or j > 5 else vector[j - 3]


@compiled
def pose_hand(state, base_frames, base, lengths, mirror, frames, joints):
    """Frames and joints of one hand, see skeleton.forward_kinematics; all float64.

    state: (27,).  base_frames: (5, 3, 3), base: (5, 3), lengths: (5, 3) of the shape.
    mirror: -1 for a left hand, else 1.  frames: (16, 3, 3) and joints: (21, 3), written.
    """
    q = quaternion(state[3], state[4], state[5])
    for j in range(3):
        column = turned(
            q, mirror if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0
        )
        for i in range(3):
            frames[0, i, j] = column[i]
    for i in range(3):
        joints[0, i] = state[i]
    angle = 6
    for finger in range(5):
        joint = 1 + 4 * finger
        for i in range(3):
            joints[joint, i] = state[i]
            for k in range(3):
                joints[joint, i] += frames[0, i, k] * base[finger, k]
        for bone in range(3):
            frame = frames[1 + 3 * finger + bone]
            for i in range(3):
                for j in range(3):
                    if bone > 0:
                        frame[i, j] = frames[3 * finger + bone, i, j]
                    else:
                        frame[i, j] = 0.0
                        for k in range(3):
                            frame[i, j] += frames[0, i, k] * base_frames[finger, k, j]
            # Only the thumb has an abduction at its second joint; no third joint has any.
            for column in range(0 if bone == 0 or (bone == 1 and finger == 0) else 1, 2):
                mix_columns(frame, column, state[angle])
                angle += 1
            for i in range(3):
                along = lengths[finger, bone] * frame[i, 1]
                joints[joint + bone + 1, i] = joints[joint + bone, i] - along


@compiled
def mix_columns(frame, column, angle):
    """Turn a frame about its z axis (column 0) or its x axis (column 1)."""
    sine, cosine = math.sin(angle), math.cos(angle)
    for i in range(3):
        p, q = frame[i, column], frame[i, column + 1]
        frame[i, column] = cosine * p + sine * q
        frame[i, column + 1] = cosine * q - sine * p


@entry_point
def joints_of(states, base_frames, base, lengths, mirror, joints, frames_out):
    """The joints of N hands, see pose_hand; states: (N, 27), joints: (N, 21, 3) float32.

    frames_out: (N, 16, 3, 3) float32 for their frames, or (0, 16, 3, 3).
    """
    frames, posed, state = np.empty((16, 3, 3)), np.empty((21, 3)), np.empty(27)
    for i in range(len(states)):
        for j in range(27):  # slices take numba long to compile
            state[j] = states[i, j]
        pose_hand(state, base_frames, base, lengths, mirror, frames, posed)
        for j in range(21):
            for k in range(3):
                joints[i, j, k] = posed[j, k]
        for j in range(16 if i < len(frames_out) else 0):
            for k in range(3):
                for column in range(3):
                    frames_out[i, j, k, column] = frames[j, k, column]


def compose(reference: Tensor, tangent: Tensor) -> Tensor:
    """See rigid.compose; on the CPU, in float32."""
    left, right = _rows(reference), _rows(tangent)
    out = np.empty(np.broadcast_shapes(left.shape, right.shape), np.float32)
    compose_rows(left, right, _PIVOT, out)
    return torch.from_numpy(out)


def redraw(
    particles: Tensor,
    weights: Tensor,
    positions: Tensor,
    tangents: Tensor,
    lower: Tensor,
    upper: Tensor,
    mode: str,
) -> Tensor:
    """See rigid.redraw; on the CPU, in float32."""
    moves, shares = _rows(tangents), weights.double().numpy()
    out, ends = np.empty(moves.shape, np.float32), (_rows(lower), _rows(upper))
    given = _rows(particles), shares, positions.numpy(), moves, *ends, mode == "reflect"
    redraw_rows(*given, _PIVOT, out)
    return torch.from_numpy(out)


def difference(particles: Tensor, reference: Tensor) -> Tensor:
    """See rigid.difference; on the CPU, in float32."""
    out = np.empty(particles.shape, np.float32)
    difference_rows(_rows(particles), _rows(reference), _PIVOT, out)
    return torch.from_numpy(out)


def mean(particles: Tensor, weights: Tensor) -> Tensor:
    """See rigid.mean; on the CPU, in float32."""
    out = np.empty((1, particles.shape[1]), np.float32)
    mean_row(_rows(particles), weights.double().numpy(), out[0])
    return torch.from_numpy(out)


def _rows(tensor: Tensor) -> np.ndarray:
    # numpy's conversions take a tenth of the time of torch's.
    return np.ascontiguousarray(tensor.numpy(), np.float32)


MOTIONS = Motions(compose, difference, redraw, mean)
