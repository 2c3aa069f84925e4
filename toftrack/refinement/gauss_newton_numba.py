"""Refinement in compiled code: all iterations of gauss_newton.py in one call on the CPU.

The formulas and their names are those of the reference in plain
torch, tests/reference/refinement.py. What a residual says of a point, it says of the frame that
carries it: the force w = (n, x cross n) along its derivative n. So w w' and w times the residual
are first summed up frame by frame, and the degrees of freedom come in once for all of them.
Distances to the ellipsoids are float32 over all points side by side; all else is float64.

Throughout, `hand` is a posed hand: its frames (16, 3, 3), joints (21, 3) and the axes of its angles
(21, 3); `wrenches` (16, 7, 6) are the sums of each frame, those with the residuals in the last row.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy import empty, zeros
from torch import Tensor

from toftrack.compute.compiling import compiled, entry_point, shared_entry_point
from toftrack.compute.rigid_numba import joints_of, pose_hand, product, quaternion, rotation_vector
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import ANGLE_LIMITS, HandPose
from toftrack.hand.surface import Ellipsoids, hand_surface
from toftrack.refinement.gauss_newton import (
    ALONG_BONE,
    FACING_M,
    JOINT_FRAME,
    KEYPOINT_SIGMAS,
    NEAREST_M,
    POINT_REACH,
    SILHOUETTE_PX,
    Keypoints,
    Refinement,
)
from toftrack.refinement.seen_points import REACH_M, SeenPoints, nearest_solid

_JOINT_FRAME = np.array(JOINT_FRAME)
_REACH = np.float32(REACH_M**2)
_LIMITS = np.array(ANGLE_LIMITS)
_NO_FRAMES = np.empty((0, 16, 3, 3), np.float32)
_ORIGINS = np.array([0, *(1 + 4 * finger + bone for finger in range(5) for bone in range(3))])
"""The joints at which the frames of a hand begin."""
_FREE = 27
"""Degrees of freedom: translation, rotation about the wrist, angles."""


@compiled
def choose_points(points, joints, count, within, chosen):
    """Points of one hypothesis, see points_around of the reference; returns how many there are.

    points: (P, 3) float32.  joints: (21, 3).  within: (P + 1,) int32 scratch.
    chosen: (3, count), its first columns are set.
    """
    middle = zeros(3, np.float32)
    for i in range(3):
        total = 0.0
        for j in range(21):
            total += joints[j, i]
        middle[i] = np.float32(total / 21)
    x, y, z = middle[0], middle[1], middle[2]
    near = 0
    for p in range(len(points)):
        # One after the other, without a branch: what is not near is overwritten.
        within[near] = p
        a, b, c = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
        near += a * a + b * b + c * c < _REACH
    stride = max(1, (near + count - 1) // count)
    found = 0
    for rank in range(0, near, stride):
        for i in range(3):
            chosen[i, found] = points[within[rank], i]
        found += 1
    return found


@compiled
def pose_ellipsoids(frames, joints, index, centres, axes, posed):
    """Rows of (12,) float32: the whitening W by rows and W c, so that q = W p - W c."""
    for e in range(len(posed)):
        frame = frames[index[e]]
        origin = _ORIGINS[index[e]]
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
            square = q0 * q0 + q1 * q1 + q2 * q2
            steep = max(n0 * n0 + n1 * n1 + n2 * n2, np.float32(1e-12))
            found = (square - math.sqrt(square)) / math.sqrt(steep)
            closer = found < distance[p]
            distance[p] = found if closer else distance[p]
            nearest[p] = which if closer else nearest[p]


@compiled
def joint_axes(frames, base_frames, mirror, axes):
    """The axes of the 21 angles, (21, 3): each turns what is attached beyond it."""
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
def add_wrench(frame, x, n, weight, residual, wrenches):
    """Add n.X's derivative at X = x, which moves with a frame, to what is known of the frame.

    weight: of the derivative.  residual: weighted.  wrenches: see the module's text.
    """
    w0, w1, w2 = weight * n[0], weight * n[1], weight * n[2]
    w3, w4, w5 = x[1] * w2 - x[2] * w1, x[2] * w0 - x[0] * w2, x[0] * w1 - x[1] * w0
    w = (w0, w1, w2, w3, w4, w5)
    sums = wrenches[frame]
    for i in range(6):
        for j in range(6):
            sums[i, j] += w[i] * w[j]
        sums[6, i] += residual * w[i]


@compiled
def add_points(matched, count, index, posed, hand, settings, wrenches):
    """The seen points' part of the normal equations, see point_residuals.

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
        steepness = 1 / max(math.sqrt(n0 * n0 + n1 * n1 + n2 * n2), 1e-6)
        n = (n0 * steepness, n1 * steepness, n2 * steepness)
        beyond = 0.0
        for i in range(3):
            beyond += ((x, y, z)[i] - joints[0, i]) * frames[0, i, 1]
        if n[0] * x + n[1] * y + n[2] * z >= 0 or beyond > FACING_M:
            continue
        weight = 1 / ((1 + (d / (POINT_REACH * reach)) ** 2) * point)
        at = (x - d * n[0], y - d * n[1], z - d * n[2])
        add_wrench(index[nearest[p]], at, n, -weight, d * weight, wrenches)


@compiled
def add_silhouette(seen, lengths, hand, deviation, wrenches):
    """The silhouette's part of the normal equations, see silhouette_residuals."""
    _, beside, corner, size, k = seen
    frames, joints, _ = hand
    if beside.shape[0] == 0:
        return
    for frame in range(1, 16):
        origin = _ORIGINS[frame]
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
            column = min(max(int(np.rint(u)) - corner[1], 0), beside.shape[1] - 1)
            line = min(max(int(np.rint(v)) - corner[0], 0), beside.shape[0] - 1)
            if beside[line, column] == column:  # on it, and so at most a pixel's half from one
                continue
            row, place = nearest_solid(beside, line, column)
            gap_u, gap_v = u - (place + corner[1]), v - (row + corner[0])
            outside = math.sqrt(gap_u * gap_u + gap_v * gap_v)
            if outside <= 1:
                continue
            weight = 1 / ((1 + (outside / SILHOUETTE_PX) ** 2) * deviation)
            n = (k[0, 0] / z, 0.0, -k[0, 0] * x[0] / (z * z))
            add_wrench(frame, x, n, weight, gap_u * weight, wrenches)
            n = (0.0, k[1, 1] / z, -k[1, 1] * x[1] / (z * z))
            add_wrench(frame, x, n, weight, gap_v * weight, wrenches)


@compiled
def add_keypoints(points, sigmas, hand, wrenches):
    """The keypoints' part of the normal equations, see keypoint_residuals."""
    joints = hand[1]
    for j in range(21):
        sigma = sigmas[j]
        x = (joints[j, 0], joints[j, 1], joints[j, 2])
        gap = (x[0] - points[j, 0], x[1] - points[j, 1], x[2] - points[j, 2])
        away = (gap[0] ** 2 + gap[1] ** 2 + gap[2] ** 2) / (KEYPOINT_SIGMAS * sigma) ** 2
        if not (sigma > 0 and sigma < np.inf and away < np.inf):
            continue  # what is no number is a joint that was not found
        weight = 1 / ((1 + away) * sigma)
        for i in range(3):
            n = (1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0)
            add_wrench(_JOINT_FRAME[j], x, n, weight, gap[i] * weight, wrenches)


@compiled
def assemble(wrenches, hand, twists, sums):
    """The normal equations from what is known of each frame, whose sums it overwrites.

    A degree of freedom moves a point x by its twist (l, g): by l + g x X. It moves all frames from
    its own to the finger's end, so these are added up from there (the composite-rigid-body
    algorithm, Featherstone, "Rigid body dynamics algorithms", 2008, section 6.2).
    twists: (27, 6) and sums: the matrix (27, 27), of which the lower triangle counts, and the
    gradient (27,); all written.
    """
    _, joints, axes = hand
    normal, gradient = sums
    clear(normal)
    for i in range(6):
        for j in range(6):
            twists[i, j] = 0.0
    for i in range(3):
        twists[i, i], twists[3 + i, 3 + i] = 1.0, 1.0
        # -(e x o), o being the wrist.
        j, k = (i + 1) % 3, (i + 2) % 3
        twists[3 + i, j], twists[3 + i, k] = joints[0, k], -joints[0, j]
    dof = 6
    for finger in range(5):
        for bone in range(3):
            o = joints[1 + 4 * finger + bone]
            # The first joint turns twice, and so does the thumb's second one.
            for _ in range(2 if bone == 0 or (bone == 1 and finger == 0) else 1):
                a = axes[dof - 6]
                for i in range(3):
                    j, k = (i + 1) % 3, (i + 2) % 3
                    twists[dof, i], twists[dof, 3 + i] = a[k] * o[j] - a[j] * o[k], a[i]
                dof += 1
        for bone in range(2, -1, -1):
            to, of = wrenches[0 if bone == 0 else 3 * finger + bone], 3 * finger + bone + 1
            for i in range(7):
                for j in range(6):
                    to[i, j] += wrenches[of, i, j]
    dof = np.int64(6)  # no literal, for which numba compiles _couple once more
    for finger in range(5):
        first = dof
        for bone in range(3):
            for _ in range(2 if bone == 0 or (bone == 1 and finger == 0) else 1):
                _couple(dof, first, wrenches[3 * finger + bone + 1], twists, normal, gradient)
                dof += 1
    for dof in range(6):
        _couple(dof, dof + 1, wrenches[0], twists, normal, gradient)


@compiled
def clear(array):
    """Zeros; a slice that is written to takes numba seconds to compile."""
    for i in range(array.size):
        array.flat[i] = 0.0


@compiled
def _couple(dof, first, wrench, twists, normal, gradient):
    """What a degree of freedom has in common with the wrist's six and with those from `first` on.

    wrench: (7, 6) of all that it moves.
    """
    s = twists[dof]
    force = (
        _along(wrench[0], s),
        _along(wrench[1], s),
        _along(wrench[2], s),
        _along(wrench[3], s),
        _along(wrench[4], s),
        _along(wrench[5], s),
    )
    gradient[dof] = _along(wrench[6], s)
    for other in range(min(dof + 1, 6)):
        normal[dof, other] = _along(force, twists[other])
    for other in range(first, dof + 1):
        normal[dof, other] = _along(force, twists[other])


@compiled
def _along(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4] + a[5] * b[5]


@compiled
def solve(normal, gradient):
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


@compiled
def _move(state, prior, settings, sums):
    """One damped step of a state, see `refine` of the reference."""
    normal, gradient = sums
    _, _, _, _, _, angle_rad, damping = settings
    trust, mean = angle_rad**-2, 0.0
    for j in range(_FREE):
        if j >= 6:
            normal[j, j] += trust
            gradient[j] += trust * (state[j] - prior[j - 6])
        mean += normal[j, j] / _FREE
    for j in range(_FREE):
        normal[j, j] += damping * mean + 1e-3 * normal[j, j]
    solve(normal, gradient)
    turn = quaternion(-gradient[3], -gradient[4], -gradient[5])
    vector = rotation_vector(product(turn, quaternion(state[3], state[4], state[5])))
    for j in range(3):
        state[j] -= gradient[j]
        state[3 + j] = vector[j]
    for j in range(21):
        bent = state[6 + j] - gradient[6 + j]
        state[6 + j] = min(max(bent, _LIMITS[j, 0]), _LIMITS[j, 1])


@shared_entry_point
def refine_hands(states, priors, keypoints, seen, shape, surface, settings):
    """Refine hands, one after the other: a few are done before a second thread is awake.

    states: (N, 27) float64, overwritten.  priors: (N, 21).
    keypoints: (N, 21, 3) and (N, 21), or one for all; inf = none.
    seen: points (P, 3) float32, beside (h, w) int32 and its corner (top, left) in an image of size
        (height, width), k (3, 3).
    shape: base_frames, base, lengths, mirror, see pose_hand.
    surface: index (E,), centres (E, 3), axes (E, 3, 3).
    settings: iterations, points, reach_m, point_m, silhouette_px, angle_rad, damping.
    """
    base_frames, base, lengths, mirror = shape
    index, centres, semi_axes = surface
    iterations, points, _, _, deviation, _, _ = settings
    most = min(points, len(seen[0]))
    frames, joints, axes = empty((16, 3, 3)), empty((21, 3)), empty((21, 3))
    xyz, within = empty((3, most), np.float32), empty(len(seen[0]) + 1, np.int32)
    distance, nearest = empty(most, np.float32), zeros(most, np.int32)
    hand, matched = (frames, joints, axes), (xyz, distance, nearest)
    posed, sums = empty((len(index), 12), np.float32), (empty((_FREE, _FREE)), empty(_FREE))
    wrenches, twists = empty((16, 7, 6)), empty((_FREE, 6))
    for i in range(len(states)):
        state, row = states[i], i % max(1, len(keypoints[0]))
        known, sigma = keypoints[0][row], keypoints[1][row]
        pose_hand(state, base_frames, base, lengths, mirror, frames, joints)
        count = choose_points(seen[0], joints, points, within, xyz)
        informed = count > 0
        for j in range(len(sigma)):
            informed |= sigma[j] > 0 and sigma[j] < np.inf
        for _ in range(iterations if informed else 0):
            pose_hand(state, base_frames, base, lengths, mirror, frames, joints)
            pose_ellipsoids(frames, joints, index, centres, semi_axes, posed)
            joint_axes(frames, base_frames, mirror, axes)
            clear(wrenches)
            nearest_ellipsoids(xyz, count, posed, distance, nearest)
            add_points(matched, count, index, posed, hand, settings, wrenches)
            add_silhouette(seen, lengths, hand, deviation, wrenches)
            add_keypoints(known, sigma, hand, wrenches)
            assemble(wrenches, hand, twists, sums)
            _move(state, priors[i], settings, sums)


@entry_point
def pose_surface(state, shape, surface, centres_out, axes_out):
    """The ellipsoids of a hand (27,), see HandSurface.pose; shape, surface: see refine_hands.

    centres_out: (E, 3), axes_out: (E, 3, 3), written.
    """
    index, centres, axes = surface
    frames, joints = empty((16, 3, 3), np.float64), empty((21, 3), np.float64)
    pose_hand(state, *shape, frames, joints)
    for e in range(len(index)):
        frame, origin = frames[index[e]], _ORIGINS[index[e]]
        for i in range(3):
            centres_out[e, i] = joints[origin, i]
            for j in range(3):
                centres_out[e, i] += frame[i, j] * centres[e, j]
                axes_out[e, i, j] = 0
                for k in range(3):
                    axes_out[e, i, j] += frame[i, k] * axes[e, k, j]


class Refiner:
    """Brings hands of one shape onto what is seen, on the CPU."""

    def __init__(self, shape: HandShape) -> None:
        surface = hand_surface(shape)
        self._shape = (
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

    def joints(self, states: Tensor, frames: np.ndarray = _NO_FRAMES) -> Tensor:
        """(N, 27) to the joints (N, 21, 3), camera frame, metres; the frames are written, too."""
        joints = np.empty((len(states), 21, 3), np.float32)
        states_read = np.ascontiguousarray(states.numpy(), np.float32)
        joints_of(states_read, *self._shape, joints, frames)
        return torch.from_numpy(joints)

    def pose(self, states: Tensor) -> HandPose:
        """(N, 27) to joints and frames, see skeleton.forward_kinematics."""
        frames = torch.empty(len(states), 16, 3, 3)
        joints = self.joints(states, frames.numpy())
        return HandPose(joints, frames, joints[:, _ORIGINS])

    def surface(self, state: Tensor) -> Ellipsoids:
        """(1, E) the ellipsoids of a hand (1, 27), without the wrist's; camera frame."""
        count = len(self._surface[0])
        posed = np.empty((1, count, 3), np.float32), np.empty((1, count, 3, 3), np.float32)
        pose_surface(_array(state[0]), self._shape, self._surface, posed[0][0], posed[1][0])
        return Ellipsoids(*map(torch.from_numpy, posed))

    def __call__(
        self,
        states: Tensor,
        prior_angles: Tensor,
        seen: SeenPoints,
        settings: Refinement,
        keypoints: Keypoints | None = None,
    ) -> Tensor:
        """(N, 27) the hands `states`, each refined by itself, see gauss_newton.py.

        prior_angles: (N, 21) the poses that the filter believes in.
        A hand within whose reach nothing is seen, and of which no keypoint is known, stays.
        """
        names = ("reach_m", "point_m", "silhouette_px", "angle_rad", "damping")
        numbers = tuple(float(getattr(settings, name)) for name in names)
        counts = int(settings.iterations), int(settings.points)
        if keypoints is None:
            known = np.empty((1, 21, 3)), np.full((1, 21), np.inf)
        else:
            points = _array(keypoints.points_m).reshape(-1, 21, 3)
            sigma = np.broadcast_to(_array(keypoints.sigma_m), (len(points), 21))
            known = points, sigma.copy()  # which may be written to, as the kernel was compiled for
        refined = _array(states)
        refine_hands(
            refined,
            _array(prior_angles),
            known,
            (
                seen.points_m.contiguous().numpy(),
                seen.beside.contiguous().numpy(),
                seen.corner,
                seen.size,
                _array(seen.k),
            ),
            self._shape,
            self._surface,
            counts + numbers,
        )
        return torch.from_numpy(refined.astype(np.float32))


def _array(tensor: Tensor) -> np.ndarray:
    """A float64 copy."""
    return tensor.numpy().astype(np.float64, order="C")
