"""What is seen of one hand as normal equations, compiled; see gauss_newton_numba.py.

The formulas and their names are those of gauss_newton.py, which is the reference. A point only
touches the wrist's six degrees of freedom and those of its finger up to its bone, so its part of
the normal equations is small. Distances to the ellipsoids are float32 over all points side by side;
everything else is float64.

Throughout, `hand` is what gauss_newton_numba.scratch says of a posed hand: its frames (16, 3, 3),
joints (21, 3) and the axes of its angles (21, 3); `sums` is a row (11,), the normal matrix
(27, 27), of which the lower triangle counts, and the gradient (27,).
"""

from __future__ import annotations

import math

import numpy as np

from toftrack.compute.compiling import compiled
from toftrack.refinement.gauss_newton import (
    ALONG_BONE,
    FACING_M,
    JOINT_FRAME,
    LANDMARK_SIGMAS,
    NEAREST_M,
    POINT_REACH,
    SILHOUETTE_PX,
)
from toftrack.refinement.seen_points import REACH_M

_ONE = np.float32(1.0)
_JOINT_FRAME = np.array(JOINT_FRAME)
_REACH = np.float32(REACH_M**2)


@compiled
def choose_points(points, joints, count, chosen):
    """Points of one hypothesis, see SeenPoints.around; returns how many there are.

    points: (P, 3) float32.  joints: (21, 3).  chosen: (3, count), its first columns are set.
    """
    middle = np.zeros(3, np.float32)
    for i in range(3):
        total = 0.0
        for j in range(21):
            total += joints[j, i]
        middle[i] = np.float32(total / 21)
    near = 0
    for p in range(len(points)):
        near += _within(points[p], middle)
    stride = max(1, (near + count - 1) // count)
    rank, found = 0, 0
    for p in range(len(points)):
        if _within(points[p], middle):
            if rank % stride == 0:
                for i in range(3):
                    chosen[i, found] = points[p, i]
                found += 1
            rank += 1
    return found


@compiled
def _within(point, middle):
    a, b, c = point[0] - middle[0], point[1] - middle[1], point[2] - middle[2]
    return a * a + b * b + c * c < _REACH


@compiled
def pose_ellipsoids(frames, joints, index, centres, axes, posed):
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
def nearest_ellipsoids(xyz, count, posed, distance, nearest):
    """First-order distance of the points to their nearest ellipsoid, and which that is."""
    x, y, z = xyz[0], xyz[1], xyz[2]
    for p in range(count):
        distance[p] = np.float32(1e9)
    for e in range(len(posed)):
        a, b, c, d, e0, f, g, h, i, s, t, u = posed[e]
        which = np.int32(e)
        for p in range(count):
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
def joint_axes(frames, base_frames, mirror, axes):
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
def add_row(frame, x, n, weight, residual, hand, sums):
    """Add n.X's derivative at X = x, which moves with a frame, to the normal equations.

    weight: of the derivative.  residual: weighted.  hand, sums: see the module's text.
    """
    _, joints, axes = hand
    row, normal, gradient = sums
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
def add_points(matched, count, index, posed, hand, settings, sums):
    """The seen points' part of the normal equations, see gauss_newton.point_residuals.

    matched: points (3, P), their distances (P,) and their ellipsoids (P,), of which `count` count.
    """
    xyz, distance, nearest = matched
    frames, joints, _ = hand
    _, _, reach, point, _, _, _ = settings
    for p in range(count):
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
        if n[0] * x + n[1] * y + n[2] * z >= 0 or beyond > FACING_M:
            continue
        weight = 1 / ((1 + (d / (POINT_REACH * reach)) ** 2) * point)
        at = (x - d * n[0], y - d * n[1], z - d * n[2])
        add_row(index[nearest[p]], at, n, -weight, d * weight, hand, sums)


@compiled
def add_silhouette(seen, lengths, hand, deviation, sums):
    """The silhouette's part of the normal equations, see gauss_newton.silhouette_residuals."""
    _, nearest_px, corner, size, k = seen
    frames, joints, _ = hand
    if nearest_px.shape[0] == 0:
        return
    for frame in range(1, 16):
        origin = _origin(joints, frame)
        length = lengths[(frame - 1) // 3, (frame - 1) % 3]
        for part in ALONG_BONE:
            x = (
                joints[origin, 0] - part * length * frames[frame, 0, 1],
                joints[origin, 1] - part * length * frames[frame, 1, 1],
                joints[origin, 2] - part * length * frames[frame, 2, 1],
            )
            z = max(x[2], NEAREST_M)
            u, v = k[0, 0] * x[0] / z + k[0, 2], k[1, 1] * x[1] / z + k[1, 2]
            if not (0 < u < size[1] - 1 and 0 < v < size[0] - 1):
                continue
            column = min(max(int(np.rint(u)) - corner[1], 0), nearest_px.shape[1] - 1)
            line = min(max(int(np.rint(v)) - corner[0], 0), nearest_px.shape[0] - 1)
            gap_u, gap_v = u - nearest_px[line, column, 0], v - nearest_px[line, column, 1]
            outside = math.sqrt(gap_u * gap_u + gap_v * gap_v)
            if outside <= 1:
                continue
            weight = 1 / ((1 + (outside / SILHOUETTE_PX) ** 2) * deviation)
            n = (k[0, 0] / z, 0.0, -k[0, 0] * x[0] / (z * z))
            add_row(frame, x, n, weight, gap_u * weight, hand, sums)
            n = (0.0, k[1, 1] / z, -k[1, 1] * x[1] / (z * z))
            add_row(frame, x, n, weight, gap_v * weight, hand, sums)


@compiled
def add_landmarks(points, sigmas, hand, sums):
    """The landmarks' part of the normal equations, see gauss_newton.landmark_residuals."""
    joints = hand[1]
    for j in range(21):
        sigma = sigmas[j]
        if not sigma < np.inf:
            continue
        x = (joints[j, 0], joints[j, 1], joints[j, 2])
        gap = (x[0] - points[j, 0], x[1] - points[j, 1], x[2] - points[j, 2])
        away = (gap[0] ** 2 + gap[1] ** 2 + gap[2] ** 2) / (LANDMARK_SIGMAS * sigma) ** 2
        weight = 1 / ((1 + away) * sigma)
        frame = _JOINT_FRAME[j]
        add_row(frame, x, (1.0, 0.0, 0.0), weight, gap[0] * weight, hand, sums)
        add_row(frame, x, (0.0, 1.0, 0.0), weight, gap[1] * weight, hand, sums)
        add_row(frame, x, (0.0, 0.0, 1.0), weight, gap[2] * weight, hand, sums)
