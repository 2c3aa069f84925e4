"""Refinement in compiled code: all iterations of gauss_newton.py in one call on the CPU.

Threads share the hypotheses. What is seen of each is added up in residuals_numba.py.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from numpy import empty, zeros
from torch import Tensor

from toftrack.compute.compiling import compiled, entry_point, take
from toftrack.compute.rigid_numba import joints_of, pose_hand, product, quaternion, rotation_vector
from toftrack.compute.threads import run_shared
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import ANGLE_LIMITS, HandPose
from toftrack.hand.surface import hand_surface
from toftrack.refinement.gauss_newton import Keypoints, Refinement
from toftrack.refinement.residuals_numba import (
    add_keypoints,
    add_points,
    add_silhouette,
    assemble,
    choose_points,
    clear,
    joint_axes,
    nearest_ellipsoids,
    pose_ellipsoids,
)
from toftrack.refinement.seen_points import SeenPoints

_LIMITS = np.array(ANGLE_LIMITS)
_NO_FRAMES = np.empty((0, 16, 3, 3), np.float32)
_ORIGINS = [0, *(1 + 4 * finger + bone for finger in range(5) for bone in range(3))]
"""The joints at which the frames of a hand begin."""
_FREE = 27
"""Degrees of freedom: translation, rotation about the wrist, angles."""


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
    """One damped step of a state, see gauss_newton.refine."""
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


@compiled
def _scratch(ellipsoids, points, seen):
    """What one thread works in: the hand, see residuals_numba.py, and its ellipsoids; the matched
    points, see add_points, and which they are; wrenches, twists and normal equations, see assemble.
    """
    hand = empty((16, 3, 3), np.float64), empty((21, 3), np.float64), empty((21, 3), np.float64)
    posed = empty((ellipsoids, 12), np.float32)
    distance, nearest = empty(points, np.float32), zeros(points, np.int32)
    matched = empty((3, points), np.float32), distance, nearest
    sums = empty((_FREE, _FREE), np.float64), empty(_FREE, np.float64)
    within = empty(seen + 1, np.int32)
    wrenches, twists = empty((16, 7, 6), np.float64), empty((_FREE, 6), np.float64)
    return hand, posed, matched, within, wrenches, twists, sums


@entry_point
def refine_hands(states, priors, keypoints, seen, shape, surface, settings, counter):
    """Refine hands as long as `counter` has any; called from several threads.

    states: (N, 27) float64, overwritten.  priors: (N, 21).
    keypoints: (N, 21, 3) and (N, 21), or one for all; inf = none.
    seen: points (P, 3) float32, nearest_px (h, w, 2) and its corner (top, left) in an image of
        size (height, width), k (3, 3).
    shape: base_frames, base, lengths, mirror, see pose_hand.
    surface: index (E,), centres (E, 3), axes (E, 3, 3).
    settings: iterations, points, reach_m, point_m, silhouette_px, angle_rad, damping.
    counter: (1,) int64 hands taken.
    """
    base_frames, base, lengths, mirror = shape
    index, centres, semi_axes = surface
    iterations, points, _, _, deviation, _, _ = settings
    hand, posed, matched, within, wrenches, twists, sums = _scratch(
        len(index), min(points, len(seen[0])), len(seen[0])
    )
    frames, joints, axes = hand
    xyz, distance, nearest = matched
    while True:
        i = take(counter)
        if i >= len(states):
            break
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

    def joints(self, states: Tensor) -> Tensor:
        """(N, 27) to the joints (N, 21, 3), camera frame, metres."""
        joints = torch.empty(len(states), 21, 3)
        states_read = np.ascontiguousarray(states.numpy(), np.float32)
        joints_of(states_read, *self._shape, joints.numpy(), _NO_FRAMES)
        return joints

    def pose(self, states: Tensor) -> HandPose:
        """(N, 27) to joints and frames, see skeleton.forward_kinematics."""
        joints, frames = torch.empty(len(states), 21, 3), torch.empty(len(states), 16, 3, 3)
        states_read = np.ascontiguousarray(states.numpy(), np.float32)
        joints_of(states_read, *self._shape, joints.numpy(), frames.numpy())
        return HandPose(joints, frames, joints[:, _ORIGINS])

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
        task = functools.partial(
            refine_hands,
            refined,
            _array(prior_angles),
            known,
            (
                seen.points_m.contiguous().numpy(),
                seen.nearest_px.contiguous().numpy(),
                seen.corner,
                seen.size,
                _array(seen.k),
            ),
            self._shape,
            self._surface,
            counts + numbers,
            np.zeros(1, np.int64),
        )
        run_shared(task, len(states))
        return torch.from_numpy(refined.astype(np.float32))


def _array(tensor: Tensor) -> np.ndarray:
    """A float64 copy."""
    return tensor.numpy().astype(np.float64, order="C")
