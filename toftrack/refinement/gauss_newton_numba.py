"""Refinement in compiled code: all of refine.refine's iterations in one call on the CPU.

The formulas and their names are those of refine.py, which is the reference. A point only touches
the wrist's six degrees of freedom and those of its finger up to its bone, so its part of the normal
equations is small. Distances to the ellipsoids are float32 over all points side by side; everything
else is float64.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from toftrack.compute import rigid_numba
from toftrack.compute.compiling import announced, compiled, entry_point
from toftrack.compute.rigid_numba import joints_of, pose_hand, product, quaternion, rotation_vector
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import ANGLE_LIMITS
from toftrack.hand.surface import HandSurface
from toftrack.refinement.gauss_newton import Refinement, Surroundings

_cached = entry_point(__file__, rigid_numba.__file__)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_LIMITS = np.array(ANGLE_LIMITS)
_FREE = 27
"""Degrees of freedom: translation, rotation about the wrist, angles."""


@compiled
def _pose_ellipsoids(frames, joints, index, centres, axes, posed):
    """Rows of (12,) float32: the whitening W by rows and W c, so that q = W p - W c."""
    for e in range(len(posed)):
        frame = frames[index[e]]
        origin = _origin(joints, index[e])
        for row in range(3):
            square = axes[e, 0, row] ** 2 + axes[e, 1, row] ** 2 + axes[e, 2, row] ** 2
            shift = 0.0
            for i in range(3):
                axis, centre = 0.0, joints[origin, i]
                for k in range(3):
                    axis += frame[i, k] * axes[e, k, row]
                    centre += frame[i, k] * centres[e, k]
                posed[e, 3 * row + i] = axis / square
                shift += axis / square * centre
            posed[e, 9 + row] = shift


@compiled
def _origin(joints, frame):
    """The joint at which a frame has its origin."""
    return 0 if frame == 0 else 1 + 4 * ((frame - 1) // 3) + (frame - 1) % 3


@compiled
def _nearest(x, y, z, posed, distance, nearest):
    """First-order distance of every point to its nearest ellipsoid, and which that is."""
    for p in range(len(x)):
        distance[p] = np.float32(1e9)
    for e in range(len(posed)):
        a, b, c, d, e0, f, g, h, i, s, t, u = posed[e]
        which = np.int32(e)
        for p in range(len(x)):
            q0 = a * x[p] + b * y[p] + c * z[p] - s
            q1 = d * x[p] + e0 * y[p] + f * z[p] - t
            q2 = g * x[p] + h * y[p] + i * z[p] - u
            n0 = a * q0 + d * q1 + g * q2
            n1 = b * q0 + e0 * q1 + h * q2
            n2 = c * q0 + f * q1 + i * q2
            length = math.sqrt(q0 * q0 + q1 * q1 + q2 * q2)
            steepness = max(math.sqrt(n0 * n0 + n1 * n1 + n2 * n2), np.float32(1e-6))
            found = (length - _ONE) * length / steepness
            closer = found < distance[p]
            distance[p] = found if closer else distance[p]
            nearest[p] = which if closer else nearest[p]


@compiled
def _joint_axes(frames, base_frames, mirror, axes):
    """The axes of the 21 angles, (21, 3), see refine.point_jacobian."""
    angle = 0
    for finger in range(5):
        for bone in range(3):
            for i in range(3):
                if bone == 0:
                    z = 0.0
                    for k in range(3):
                        z += frames[0, i, k] * base_frames[finger, k, 2]
                    axes[angle, i] = mirror * z
                elif bone == 1 and finger == 0:
                    axes[angle, i] = mirror * frames[1, i, 2]
            if bone == 0 or (bone == 1 and finger == 0):
                angle += 1
            for i in range(3):
                axes[angle, i] = mirror * frames[1 + 3 * finger + bone, i, 0]
            angle += 1


@compiled
def _add_row(frame, x, n, weight, residual, joints, axes, row, normal, gradient):
    """Add n.X's derivative at X = x, which moves with a frame, to the normal equations.

    weight: of the derivative.  residual: weighted.  row: (11,) scratch.
    """
    # (X - O) x n = X x n - O x n, whatever the origin O.
    m0, m1, m2 = x[1] * n[2] - x[2] * n[1], x[2] * n[0] - x[0] * n[2], x[0] * n[1] - x[1] * n[0]
    o = joints[0]
    row[0], row[1], row[2] = weight * n[0], weight * n[1], weight * n[2]
    row[3] = weight * (m0 - o[1] * n[2] + o[2] * n[1])
    row[4] = weight * (m1 - o[2] * n[0] + o[0] * n[2])
    row[5] = weight * (m2 - o[0] * n[1] + o[1] * n[0])
    first, count = 0, 0
    if frame > 0:
        finger, bone = (frame - 1) // 3, (frame - 1) % 3
        first = 4 * finger + (1 if finger > 0 else 0)
        # The first joint turns twice, and so does the thumb's second one.
        count = bone + 2 + (1 if finger == 0 and bone > 0 else 0)
        for j in range(count):
            joint = j // 2 if finger == 0 else max(j - 1, 0)
            o, a = joints[1 + 4 * finger + joint], axes[first + j]
            row[6 + j] = weight * (
                a[0] * (m0 - o[1] * n[2] + o[2] * n[1])
                + a[1] * (m1 - o[2] * n[0] + o[0] * n[2])
                + a[2] * (m2 - o[0] * n[1] + o[1] * n[0])
            )
    for i in range(6 + count):
        to = i if i < 6 else first + i
        gradient[to] += row[i] * residual
        for j in range(min(i + 1, 6)):
            normal[to, j] += row[i] * row[j]
        for j in range(6, i + 1):
            normal[to, first + j] += row[i] * row[j]


@compiled
def _add_points(
    xyz, distance, nearest, index, posed, frames, joints, axes, reach, point, row, normal, gradient
):
    """The seen points' part of the normal equations, see refine._point_rows."""
    for p in range(xyz.shape[1]):
        d = np.float64(distance[p])
        if not abs(d) < reach:
            continue
        w = posed[nearest[p]]
        x, y, z = np.float64(xyz[0, p]), np.float64(xyz[1, p]), np.float64(xyz[2, p])
        q0 = w[0] * x + w[1] * y + w[2] * z - w[9]
        q1 = w[3] * x + w[4] * y + w[5] * z - w[10]
        q2 = w[6] * x + w[7] * y + w[8] * z - w[11]
        n0 = w[0] * q0 + w[3] * q1 + w[6] * q2
        n1 = w[1] * q0 + w[4] * q1 + w[7] * q2
        n2 = w[2] * q0 + w[5] * q1 + w[8] * q2
        steepness = max(math.sqrt(n0 * n0 + n1 * n1 + n2 * n2), 1e-6)
        n = (n0 / steepness, n1 / steepness, n2 / steepness)
        beyond = 0.0
        for i in range(3):
            beyond += ((x, y, z)[i] - joints[0, i]) * frames[0, i, 1]
        if n[0] * x + n[1] * y + n[2] * z >= 0 or beyond > 0.005:
            continue
        weight = 1 / ((1 + (d / (0.4 * reach)) ** 2) * point)
        at = (x - d * n[0], y - d * n[1], z - d * n[2])
        frame = index[nearest[p]]
        _add_row(frame, at, n, -weight, d * weight, joints, axes, row, normal, gradient)


@compiled
def _add_silhouette(
    nearest_px, corner, size, k, frames, joints, axes, lengths, deviation, row, normal, gradient
):
    """The silhouette's part of the normal equations, see refine._silhouette_rows."""
    for frame in range(1, 16):
        origin = _origin(joints, frame)
        length = lengths[(frame - 1) // 3, (frame - 1) % 3]
        for part in (0.25, 0.6, 0.9):
            x = (
                joints[origin, 0] - part * length * frames[frame, 0, 1],
                joints[origin, 1] - part * length * frames[frame, 1, 1],
                joints[origin, 2] - part * length * frames[frame, 2, 1],
            )
            z = max(x[2], 0.05)
            u, v = k[0, 0] * x[0] / z + k[0, 2], k[1, 1] * x[1] / z + k[1, 2]
            if not (0 < u < size[1] - 1 and 0 < v < size[0] - 1):
                continue
            column = min(max(int(np.rint(u)) - corner[1], 0), nearest_px.shape[1] - 1)
            line = min(max(int(np.rint(v)) - corner[0], 0), nearest_px.shape[0] - 1)
            gap_u, gap_v = u - nearest_px[line, column, 0], v - nearest_px[line, column, 1]
            outside = math.sqrt(gap_u * gap_u + gap_v * gap_v)
            if outside <= 1:
                continue
            weight = 1 / ((1 + (outside / 8) ** 2) * deviation)
            n = (k[0, 0] / z, 0.0, -k[0, 0] * x[0] / (z * z))
            _add_row(frame, x, n, weight, gap_u * weight, joints, axes, row, normal, gradient)
            n = (0.0, k[1, 1] / z, -k[1, 1] * x[1] / (z * z))
            _add_row(frame, x, n, weight, gap_v * weight, joints, axes, row, normal, gradient)


@compiled
def _solve(normal, gradient):
    """Cholesky: normal is overwritten from its lower triangle, gradient with the solution."""
    size = len(gradient)
    for j in range(size):
        for i in range(j, size):
            value = normal[i, j]
            for k in range(j):
                value -= normal[i, k] * normal[j, k]
            normal[i, j] = math.sqrt(value) if i == j else value / normal[j, j]
    for i in range(size):
        for k in range(i):
            gradient[i] -= normal[i, k] * gradient[k]
        gradient[i] /= normal[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            gradient[i] -= normal[k, i] * gradient[k]
        gradient[i] /= normal[i, i]


@_cached
def refine_hand(state, prior, limits, seen, hand, surface, settings):
    """All iterations on one hand; `state` is overwritten.

    state: (27,) float64.  prior: (21,).  limits: (21, 2).
    seen: points (3, P) float32, nearest_px (h, w, 2) and its corner (top, left) in an image of
        size (height, width), k (3, 3).
    hand: base_frames, base, lengths, mirror, see pose_hand.
    surface: index (E,), centres (E, 3), axes (E, 3, 3).
    settings: iterations, reach_m, point_m, silhouette_px, angle_rad, damping.
    """
    xyz, nearest_px, corner, size, k = seen
    base_frames, base, lengths, mirror = hand
    index, centres, semi_axes = surface
    iterations, reach, point, deviation, angle_rad, damping = settings
    frames, joints, axes = np.empty((16, 3, 3)), np.empty((21, 3)), np.empty((21, 3))
    posed = np.empty((len(index), 12), np.float32)
    distance, nearest = np.empty(xyz.shape[1], np.float32), np.empty(xyz.shape[1], np.int32)
    normal, gradient, row = np.empty((_FREE, _FREE)), np.empty(_FREE), np.empty(11)
    trust = angle_rad**-2
    for _ in range(iterations):
        pose_hand(state, base_frames, base, lengths, mirror, frames, joints)
        _pose_ellipsoids(frames, joints, index, centres, semi_axes, posed)
        _joint_axes(frames, base_frames, mirror, axes)
        normal[:], gradient[:] = 0.0, 0.0
        _nearest(xyz[0], xyz[1], xyz[2], posed, distance, nearest)
        _add_points(
            xyz,
            distance,
            nearest,
            index,
            posed,
            frames,
            joints,
            axes,
            reach,
            point,
            row,
            normal,
            gradient,
        )
        _add_silhouette(
            nearest_px,
            corner,
            size,
            k,
            frames,
            joints,
            axes,
            lengths,
            deviation,
            row,
            normal,
            gradient,
        )
        mean = 0.0
        for j in range(_FREE):
            if j >= 6:
                normal[j, j] += trust
                gradient[j] += trust * (state[j] - prior[j - 6])
            mean += normal[j, j] / _FREE
        for j in range(_FREE):
            normal[j, j] += damping * mean + 1e-3 * normal[j, j]
        _solve(normal, gradient)
        turn = quaternion(-gradient[3], -gradient[4], -gradient[5])
        vector = rotation_vector(product(turn, quaternion(state[3], state[4], state[5])))
        for j in range(3):
            state[j] -= gradient[j]
            state[3 + j] = vector[j]
        for j in range(21):
            bent = state[6 + j] - gradient[6 + j]
            state[6 + j] = min(max(bent, limits[j, 0]), limits[j, 1])


class CompiledRefiner:
    """Refines hands of one shape on the CPU; see refine.Refiner."""

    def __init__(self, shape: HandShape, surface: HandSurface) -> None:
        """Compiles the kernel if need be, some seconds once on a machine."""
        self._hand = (
            _array(shape.base_frames),
            _array(shape.base_m),
            _array(shape.bone_lengths_m),
            -1.0 if shape.side == "left" else 1.0,
        )
        self._surface = (
            surface.frame_index[:-1].numpy().astype(np.int64),
            _array(surface.centres_m[:-1]),
            _array(surface.axes_m[:-1]),
        )
        if not refine_hand.signatures:
            with announced("refine: compiling the numba kernel (once, about 3 s)"):
                state = torch.zeros(1, 27)
                seen = Surroundings(torch.ones(1, 3), torch.zeros(1, 1, 2), torch.eye(3), (1, 1))
                self(state, state[:, 6:], seen, Refinement())
                self.joints(state)

    def joints(self, state: Tensor) -> Tensor:
        """(1, 27) to the joints (21, 3), camera frame, metres."""
        joints = np.empty((1, 21, 3))
        joints_of(_array(state), *self._hand, joints)
        return torch.from_numpy(joints.astype(np.float32))[0]

    def __call__(
        self, state: Tensor, prior_angles: Tensor, seen: Surroundings, settings: Refinement
    ) -> Tensor:
        """See refine.refine."""
        refined = _array(state[0])
        refine_hand(
            refined,
            _array(prior_angles[0]),
            _LIMITS,
            (
                np.ascontiguousarray(seen.points_m.numpy().T),
                seen.nearest_px.numpy(),
                seen.corner,
                seen.size,
                _array(seen.k),
            ),
            self._hand,
            self._surface,
            (
                settings.iterations,
                settings.reach_m,
                settings.point_m,
                settings.silhouette_px,
                settings.angle_rad,
                settings.damping,
            ),
        )
        return torch.from_numpy(refined.astype(np.float32))[None]


def _array(tensor: Tensor) -> np.ndarray:
    """A float64 copy."""
    return tensor.detach().numpy().astype(np.float64)
