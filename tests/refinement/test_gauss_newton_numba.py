"""The compiled parts of the refinement, each by itself against the one reference."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from helpers.settings import refinement
from reference.refinement import (
    Residuals,
    keypoint_residuals,
    point_jacobian,
    point_residuals,
    silhouette_residuals,
)
from torch import Tensor

from toftrack.compute.compiling import entry_point
from toftrack.compute.rigid_numba import pose_hand
from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, HandPose, forward_kinematics
from toftrack.hand.surface import HandSurface, hand_surface
from toftrack.refinement import gauss_newton_numba as compiled
from toftrack.refinement.gauss_newton import Keypoints
from toftrack.refinement.gauss_newton_numba import Refiner
from toftrack.refinement.seen_points import SeenPoints, smooth_points

pytestmark = pytest.mark.usefixtures("one_thread")

SETTINGS = refinement()
SIDES = ("right", "left")
K = np.array([[220.0, 0.0, 88.0], [0.0, 215.0, 72.0], [0.0, 0.0, 1.0]])

# What an entry point calls cannot be called from Python: one that calls it.
_nearest = entry_point(lambda *a: compiled.nearest_ellipsoids(*a))
_add_wrench = entry_point(lambda *a: compiled.add_wrench(*a))
_add_points = entry_point(lambda *a: compiled.add_points(*a))
_add_silhouette = entry_point(lambda *a: compiled.add_silhouette(*a))
_add_keypoints = entry_point(lambda *a: compiled.add_keypoints(*a))
_assemble = entry_point(lambda *a: compiled.assemble(*a))


@entry_point
def _pose(state, shape, surface, hand, posed):
    base_frames, base, lengths, mirror = shape
    pose_hand(state, base_frames, base, lengths, mirror, hand[0], hand[1])
    compiled.joint_axes(hand[0], base_frames, mirror, hand[2])
    compiled.pose_ellipsoids(hand[0], hand[1], surface[0], surface[1], surface[2], posed)


@dataclass(frozen=True)
class Posed:
    """One hand as both sides have it, float64."""

    shape: HandShape
    surface: HandSurface
    pose: HandPose
    refiner: Refiner
    hand: tuple[np.ndarray, ...]
    ellipsoids: np.ndarray


def posed_hand(side: str, seed: int, z: float = 0.45) -> Posed:
    """A hand in any pose; z: of its wrist."""
    g = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(ANGLE_LIMITS, dtype=torch.float64).T
    state = torch.randn(27, generator=g, dtype=torch.float64)
    state[:3] = torch.tensor([0.0, 0.03, z])
    state[6:] = low + (high - low) * torch.rand(21, generator=g, dtype=torch.float64)
    single = default_hand_shape(side=side)
    shape, surface = single.to(torch.float64), hand_surface(single).to(torch.float64)
    refiner = Refiner(single)
    hand = np.empty((16, 3, 3)), np.empty((21, 3)), np.empty((21, 3))
    ellipsoids = np.empty((len(surface), 12), np.float32)
    _pose(state.numpy(), refiner._shape, refiner._surface, hand, ellipsoids)
    pose = forward_kinematics(state[None], shape)
    return Posed(shape, surface, pose, refiner, hand, ellipsoids)


def points_near(posed: Posed, n: int, seed: int) -> Tensor:
    """(n, 3) float32 points around the joints, on both sides of the surface."""
    g = torch.Generator().manual_seed(seed)
    joints = posed.pose.joints_m[0, torch.randint(21, (n,), generator=g)]
    return (joints + 0.012 * torch.randn(n, 3, generator=g)).float()


def no_wrenches() -> np.ndarray:
    return np.zeros((16, 7, 6))


def assembled(wrenches: np.ndarray, posed: Posed) -> tuple[np.ndarray, np.ndarray]:
    """The normal equations that the sums of the frames make."""
    sums = np.empty((27, 27)), np.empty(27)
    _assemble(wrenches, posed.hand, np.empty((27, 6)), sums)
    return sums


def check_sums(sums: tuple[np.ndarray, ...], expected: Residuals, rtol: float) -> None:
    """The normal equations, in parts of their largest entry."""
    rows, values = expected.rows[0].numpy(), expected.values[0].numpy()
    normal, gradient = rows.T @ rows, rows.T @ values
    assert np.abs(normal).max() > 0, "something is compared"
    off = np.abs(np.tril(sums[0]) - np.tril(normal)).max() / np.abs(normal).max()
    assert off < rtol
    assert np.abs(sums[1] - gradient).max() < rtol * max(np.abs(gradient).max(), 1e-9)


@pytest.mark.parametrize("side", SIDES)
def test_rows_are_those_of_the_jacobian(side: str) -> None:
    posed = posed_hand(side, 4)
    g = np.random.default_rng(5)
    for frame in range(16):
        x, n = 0.1 * g.normal(size=3) + posed.hand[1][0], g.normal(size=3)
        wrenches = no_wrenches()
        # With a weight and a residual of 1 the gradient is the row itself.
        _add_wrench(frame, tuple(x), tuple(n), 1.0, 1.0, wrenches)
        normal, gradient = assembled(wrenches, posed)
        as_tensor = (torch.from_numpy(a)[None, None] for a in (x, n))
        expected = point_jacobian(posed.pose, posed.shape, *as_tensor, torch.tensor([frame]))
        row = expected[0, 0].numpy()
        np.testing.assert_allclose(gradient, row, atol=1e-6)  # metres a radian
        np.testing.assert_allclose(np.tril(normal), np.tril(np.outer(row, row)), atol=1e-6)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("z", [0.45, 0.02, -0.5])
def test_seen_points_add_up_as_in_the_reference(side: str, z: float) -> None:
    posed = posed_hand(side, 6, z)
    points = points_near(posed, 500, 7)
    xyz = np.ascontiguousarray(points.numpy().T)
    matched = xyz, np.empty(500, np.float32), np.zeros(500, np.int32)
    _nearest(xyz, 500, posed.ellipsoids, *matched[1:])
    numbers = (5, 500, SETTINGS.reach_m, SETTINGS.point_m, 1.0, 1.0, 1.0)
    wrenches, index = no_wrenches(), posed.refiner._surface[0]
    _add_points(matched, 500, index, posed.ellipsoids, posed.hand, numbers, wrenches)
    there = torch.ones(1, 500, dtype=torch.bool)
    expected = point_residuals(
        posed.pose, points.double()[None], there, posed.shape, posed.surface, SETTINGS
    )
    # Points that are as near to two bones go to either.
    check_sums(assembled(wrenches, posed), expected, 0.01)


def silhouette(seed: int, height: int, width: int) -> SeenPoints:
    """Few pixels that are not background, anywhere: one is the nearest to most places."""
    solid = np.random.default_rng(seed).random((height, width)) < 0.002
    nothing = np.zeros((height, width), np.float32)
    points, beside = smooth_points(nothing, solid, solid, (0, 0), np.eye(3, dtype=np.float32))
    size = height, width
    seen = torch.from_numpy(points[:0].copy()), torch.from_numpy(beside)
    return SeenPoints(*seen, torch.from_numpy(K), size, (0, 0))


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(("z", "cut"), [(0.45, 0), (0.45, 31), (0.2, 0)])
def test_the_silhouette_adds_up_as_in_the_reference(side: str, z: float, cut: int) -> None:
    """cut: rows and columns that the crop lacks on either side."""
    posed, seen = posed_hand(side, 8, z), silhouette(9, 144, 176)
    solid = (seen.beside == torch.arange(176))[cut : 144 - cut, cut : 176 - cut].numpy()
    nothing, k = np.zeros(solid.shape, np.float32), np.eye(3, dtype=np.float32)
    inner = torch.from_numpy(smooth_points(nothing, solid, solid, (0, 0), k)[1])
    seen = replace(seen, beside=inner, corner=(cut, cut))
    arguments = (seen.points_m.numpy(), inner.numpy(), seen.corner, seen.size, K)
    wrenches = no_wrenches()
    _add_silhouette(arguments, posed.refiner._shape[2], posed.hand, 1.5, wrenches)
    settings = refinement(silhouette_px=1.5)
    expected = silhouette_residuals(posed.pose, seen, posed.shape, settings)
    check_sums(assembled(wrenches, posed), expected, 1e-4)


@pytest.mark.parametrize("side", SIDES)
def test_keypoints_add_up_as_in_the_reference(side: str) -> None:
    posed = posed_hand(side, 11)
    g = torch.Generator().manual_seed(12)
    points = posed.pose.joints_m + 0.02 * torch.randn(1, 21, 3, generator=g)
    sigma = 0.003 + 0.02 * torch.rand(1, 21, generator=g, dtype=torch.float64)
    sigma[0, 5], points[0, 9] = torch.inf, torch.nan
    marks = Keypoints(points, sigma)
    wrenches = no_wrenches()
    _add_keypoints(points[0].numpy(), sigma[0].numpy(), posed.hand, wrenches)
    expected = keypoint_residuals(posed.pose, marks.of_each(1), posed.shape)
    check_sums(assembled(wrenches, posed), expected, 1e-5)
