"""Refinement: its derivatives, and what it does to poses near the truth of the recording."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import roma
import torch
from helpers.tracking import sample
from torch import Tensor

from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, ANGLE_NAMES, FINGERS, forward_kinematics
from toftrack.hand.surface import hand_surface
from toftrack.output.evaluation import TIPS
from toftrack.pose_space.base import clamp_to_joint_limits
from toftrack.pose_space.inverse_kinematics import fit_angles
from toftrack.refinement.gauss_newton import (
    Refinement,
    Surroundings,
    make_refiner,
    point_jacobian,
    refine,
    surroundings,
)
from toftrack.refinement.proposals import swap_fingers
from toftrack.render.segmentation import NearestSurface

pytestmark = pytest.mark.usefixtures("one_thread")


LIMITS = torch.tensor(ANGLE_LIMITS)
SETTINGS = Refinement()
FRAMES = range(0, 100, 9)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_state(seed: int) -> Tensor:
    """(1, 27) float64 anywhere, any pose."""
    g = generator(seed)
    low, high = LIMITS.double().T
    angles = low + (high - low) * torch.rand(1, 21, generator=g, dtype=torch.float64)
    return torch.cat((torch.randn(1, 6, generator=g, dtype=torch.float64), angles), 1)


def moved(state: Tensor, change: Tensor) -> Tensor:
    """The state after a small change: translation, rotation in the camera frame, angles."""
    turned = roma.rotvec_composition((change[None, 3:6], state[:, 3:6]))
    return torch.cat((state[:, :3] + change[:3], turned, state[:, 6:] + change[6:]), 1)


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_jacobian_agrees_with_finite_differences(side: str, seed: int) -> None:
    shape = default_hand_shape(side=side).to(torch.float64)
    state, g = random_state(seed), generator(seed + 10)
    frame = torch.arange(16).repeat(4)
    local = 0.05 * torch.randn(len(frame), 3, generator=g, dtype=torch.float64)
    n = torch.randn(len(frame), 3, generator=g, dtype=torch.float64)

    def points(state: Tensor) -> Tensor:
        pose = forward_kinematics(state, shape)
        return (pose.frames[0, frame] @ local[..., None])[..., 0] + pose.origins_m[0, frame]

    found = point_jacobian(forward_kinematics(state, shape), shape, points(state), n, frame)
    step = 1e-6
    columns = []
    for axis in range(27):
        change = torch.zeros(27, dtype=torch.float64)
        change[axis] = step
        difference = points(moved(state, change)) - points(moved(state, -change))
        columns.append((n * difference).sum(1) / (2 * step))
    torch.testing.assert_close(found, torch.stack(columns, 1), atol=1e-6, rtol=0)
    assert (found != 0).any(0).all(), "every degree of freedom moves some point"


@cache
def true_states() -> Tensor:
    """(T, 27) poses of our hand that lie on the true joints of some frames."""
    scene = sample().cut(*FRAMES)
    joints = torch.from_numpy(scene.joints_m)
    shape = default_hand_shape().to(torch.float64)
    angles = fit_angles(joints[:, 1:].unflatten(1, (5, 4)), shape).angles_rad
    start = torch.cat((torch.zeros(len(angles), 6, dtype=torch.float64), angles), 1)
    flat = forward_kinematics(start, shape).joints_m
    rotation, translation = roma.rigid_points_registration(flat, joints)
    states = start.clone()
    states[:, 3:6] = roma.rotmat_to_rotvec(rotation)
    states[:, :3] = translation
    return states.float()


def seen_in(row: int, around: Tensor) -> Surroundings:
    scene = sample().cut(FRAMES[row])
    observation = NearestSurface()(scene.depth_m[0], scene.k)
    return surroundings(observation, around, SETTINGS.points)


def refined(state: Tensor, row: int, settings: Refinement = SETTINGS) -> Tensor:
    shape = default_hand_shape()
    middle = forward_kinematics(state, shape).joints_m[0].mean(0)
    seen = seen_in(row, middle)
    return refine(state, state[:, 6:], seen, shape, hand_surface(shape), settings)


def errors_mm(state: Tensor, row: int) -> np.ndarray:
    joints = forward_kinematics(state, default_hand_shape()).joints_m[0].numpy()
    return 1e3 * np.linalg.norm(joints - sample().joints_m[FRAMES[row]], axis=-1)


def test_our_hand_fits_the_true_joints_of_the_sample() -> None:
    """What the tests below start from: otherwise they would say nothing."""
    for row in range(len(FRAMES)):
        assert errors_mm(true_states()[row : row + 1], row).mean() < 6


def disturbed(row: int, seed: int) -> Tensor:
    """About 14 mm, 7 degrees and 10 degrees a joint away from the truth."""
    sigma = torch.tensor([0.008] * 3 + [0.07] * 3 + [0.17] * 21)
    change = sigma * torch.randn(27, generator=generator(100 * row + seed))
    state = moved(true_states()[row : row + 1], change)
    return torch.cat((state[:, :6], clamp_to_joint_limits(state[:, 6:])), 1)


def test_refinement_brings_a_disturbed_pose_back() -> None:
    before, after, tips_before, tips_after, better = [], [], [], [], []
    for row in range(len(FRAMES)):
        for seed in range(3):
            start = disturbed(row, seed)
            one, two = errors_mm(start, row), errors_mm(refined(start, row), row)
            before.append(one.mean())
            after.append(two.mean())
            tips_before.append(one[list(TIPS)].mean())
            tips_after.append(two[list(TIPS)].mean())
            better.append(two.mean() < one.mean())
    assert np.mean(after) < 0.6 * np.mean(before)
    assert np.mean(tips_after) < 0.75 * np.mean(tips_before)
    # Were it as likely to get better as worse, 30 of 36 would come with a probability below 1e-4.
    assert np.sum(better) >= 30


def test_refinement_leaves_the_truth_about_where_it_is() -> None:
    errors = [
        (errors_mm(state, row).mean(), errors_mm(refined(state, row), row).mean())
        for row, state in enumerate(true_states().split(1))
    ]
    before, after = np.mean(errors, 0)
    assert after < before + 2.5


def test_more_steps_come_nearer_and_none_leave_the_pose_alone() -> None:
    start = disturbed(0, 1)
    one, five = (Refinement(iterations=n) for n in (1, 5))
    assert torch.equal(refined(start, 0, Refinement(iterations=0)), start)
    assert (
        errors_mm(refined(start, 0, five), 0).mean() < errors_mm(refined(start, 0, one), 0).mean()
    )


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_compiled_refinement_agrees_with_the_reference(side: str) -> None:
    shape = default_hand_shape(side=side)
    one, two = (make_refiner(shape, hand_surface(shape), name) for name in ("torch", "numba"))
    assert type(one) is not type(two)
    for row in range(0, len(FRAMES), 2):
        scene, start = sample().cut(FRAMES[row]), disturbed(row, 0)
        if side == "left":
            scene = scene.mirrored()
            start[:, [0, 4, 5]] *= -1
        observation = NearestSurface()(scene.depth_m[0], scene.k)
        middle = forward_kinematics(start, shape).joints_m[0].mean(0)
        seen = surroundings(observation, middle, SETTINGS.points)
        found = [refiner(start, start[:, 6:], seen, SETTINGS) for refiner in (one, two)]
        joints = [forward_kinematics(state, shape).joints_m[0] for state in found]
        # A point that is as near to two bones goes to either, and the steps part by a little.
        assert float((joints[0] - joints[1]).norm(dim=1).max()) < 0.002
        error = np.linalg.norm(joints[1].numpy() - scene.joints_m[0], axis=1).mean()
        assert error < 0.025


def nothing_seen() -> Surroundings:
    """No point of a hand, and no background that a finger could stick out over."""
    scene = sample().cut(0)
    observation = NearestSurface()(scene.depth_m[0], scene.k)
    all_hand = replace(observation, hand=torch.ones_like(observation.hand))
    seen = surroundings(all_hand, torch.tensor([9.0, 9.0, 9.0]), SETTINGS.points)
    assert len(seen.points_m) == 0
    return seen


def test_nothing_seen_changes_nothing() -> None:
    state, shape = true_states()[:1], default_hand_shape()
    found = refine(state, state[:, 6:], nothing_seen(), shape, hand_surface(shape), SETTINGS)
    torch.testing.assert_close(found, state, atol=1e-6, rtol=0)


def test_without_points_the_angles_go_to_the_prior_and_the_hand_stays() -> None:
    state, shape = disturbed(0, 0), default_hand_shape()
    prior = true_states()[:1, 6:]
    found = refine(state, prior, nothing_seen(), shape, hand_surface(shape), SETTINGS)
    torch.testing.assert_close(found[:, :6], state[:, :6], atol=1e-6, rtol=0)
    torch.testing.assert_close(found[:, 6:], clamp_to_joint_limits(prior), atol=1e-4, rtol=0)


def test_points_of_nothing_near_are_left_alone() -> None:
    """Points farther than the reach from the surface are no part of the hand."""
    state, shape = true_states()[:1], default_hand_shape()
    joints = forward_kinematics(state, shape).joints_m[0]
    far = replace(nothing_seen(), points_m=joints + torch.tensor([0.3, 0.0, 0.0]))
    found = refine(state, state[:, 6:], far, shape, hand_surface(shape), SETTINGS)
    torch.testing.assert_close(found, state, atol=1e-6, rtol=0)


@pytest.mark.parametrize("seed", range(4))
def test_joint_limits_are_kept_whatever_is_seen(seed: int) -> None:
    state, shape = true_states()[:1], default_hand_shape()
    joints = forward_kinematics(state, shape).joints_m[0]
    g = generator(seed)
    noise = 0.02 * torch.randn(20, 21, 3, generator=g)
    seen = replace(nothing_seen(), points_m=(joints + noise).flatten(0, 1))
    loose = Refinement(iterations=20, angle_rad=10.0, point_m=1e-4)
    found = refine(state, state[:, 6:], seen, shape, hand_surface(shape), loose)
    assert found.isfinite().all()
    assert (found[0, 6:] >= LIMITS[:, 0] - 1e-6).all()
    assert (found[0, 6:] <= LIMITS[:, 1] + 1e-6).all()
    assert not torch.equal(found, state)


@pytest.mark.parametrize("row", range(0, len(FRAMES), 4))
def test_the_points_are_those_of_the_hand_without_its_edges(row: int) -> None:
    around = true_states()[row, :3]
    seen = seen_in(row, around)
    assert 100 < len(seen.points_m) <= SETTINGS.points
    assert ((seen.points_m - around).norm(dim=1) < 0.161).all()
    scene = sample().cut(FRAMES[row])
    pixel = (seen.points_m.double() @ torch.from_numpy(scene.k).T)[:, :2]
    u, v = (pixel / seen.points_m[:, 2:]).round().long().T
    read = torch.from_numpy(scene.depth_m[0])[v, u]
    torch.testing.assert_close(read, seen.points_m[:, 2])
    # On the silhouette the nearest pixel that is not background is the pixel itself.
    top, left = seen.corner
    assert torch.equal(seen.nearest_px[v - top, u - left], torch.stack((u, v), 1).float())


@pytest.mark.parametrize("side", ["right", "left"])
def test_swapped_hands_differ_from_the_first_in_exactly_one_finger(side: str) -> None:
    poses = torch.stack([random_state(seed)[0, 6:].float() for seed in range(8)])
    state = random_state(99).float()
    n = 400
    tried = swap_fingers(state, poses, n, generator(3))
    assert tried.shape == (n + 1, 27)
    assert torch.equal(tried[:1], state)
    assert torch.equal(tried[:, :6], state[:, :6].expand(n + 1, 6))
    finger_of = np.array([name.split("_")[0] for name in ANGLE_NAMES])
    changed = (tried[1:, 6:] != state[:, 6:]).numpy()
    names = [set(finger_of[row]) for row in changed]
    assert all(len(one) == 1 for one in names)
    # Every finger is tried: 400 fair draws leave one of five out with a probability below 1e-38.
    assert set().union(*names) == set(FINGERS)
    for row, name in zip(tried[1:], names, strict=True):
        columns = torch.from_numpy(finger_of == name.copy().pop())
        assert (row[6:][columns] == poses[:, columns]).all(1).any(), "it is taken from one pose"
    shape: HandShape = default_hand_shape(side=side)
    first, *rest = forward_kinematics(tried[:20], shape).joints_m.unbind(0)
    for joints, name in zip(rest, names, strict=False):
        still = [i for i in range(21) if i == 0 or (i - 1) // 4 != FINGERS.index(*name)]
        torch.testing.assert_close(joints[still], first[still])
