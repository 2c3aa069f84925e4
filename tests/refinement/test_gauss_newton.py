"""Refinement: its derivatives, and what it does to poses near the truth of the recording."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import roma
import torch
from helpers.configured import nearest_surface, refinement
from helpers.tracking import sample
from reference.refinement import TorchRefiner, point_jacobian, points_around, refine
from torch import Tensor

from toftrack.errors import ToftrackError
from toftrack.evaluation.trust import TIPS
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, forward_kinematics
from toftrack.hand.surface import hand_surface
from toftrack.pose_space.base import clamp_to_joint_limits
from toftrack.pose_space.inverse_kinematics import fit_angles
from toftrack.refinement.gauss_newton import JOINT_FRAME, Keypoints, Refinement
from toftrack.refinement.seen_points import SeenPoints, seen_points

pytestmark = pytest.mark.usefixtures("one_thread")


LIMITS = torch.tensor(ANGLE_LIMITS)
SETTINGS = refinement(iterations=5)
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
    turned = roma.rotvec_composition((change[None, 3:6].expand(len(state), 3), state[:, 3:6]))
    return torch.cat((state[:, :3] + change[:3], turned, state[:, 6:] + change[6:]), 1)


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_jacobian_agrees_with_finite_differences(side: str, seed: int) -> None:
    shape = default_hand_shape(side=side).to(torch.float64)
    state, g = torch.cat((random_state(seed), random_state(seed + 2))), generator(seed + 10)
    frame = torch.arange(16).repeat(4)
    local = 0.05 * torch.randn(len(frame), 3, generator=g, dtype=torch.float64)
    n = torch.randn(2, len(frame), 3, generator=g, dtype=torch.float64)

    def points(state: Tensor) -> Tensor:
        pose = forward_kinematics(state, shape)
        return (pose.frames[:, frame] @ local[..., None])[..., 0] + pose.origins_m[:, frame]

    found = point_jacobian(forward_kinematics(state, shape), shape, points(state), n, frame)
    step = 1e-6
    columns = []
    for axis in range(27):
        change = torch.zeros(27, dtype=torch.float64)
        change[axis] = step
        difference = points(moved(state, change)) - points(moved(state, -change))
        columns.append((n * difference).sum(-1) / (2 * step))
    torch.testing.assert_close(found, torch.stack(columns, -1), atol=1e-6, rtol=0)
    assert (found != 0).any(1).all(), "every degree of freedom moves some point"


@pytest.mark.parametrize("side", ["right", "left"])
def test_every_joint_moves_with_its_frame(side: str) -> None:
    """The Jacobian of the joints themselves, which landmarks pull at."""
    shape = default_hand_shape(side=side).to(torch.float64)
    state = random_state(4)
    pose = forward_kinematics(state, shape)
    n = torch.randn(1, 21, 3, generator=generator(), dtype=torch.float64)
    found = point_jacobian(pose, shape, pose.joints_m, n, torch.tensor(JOINT_FRAME))
    step = 1e-6 * torch.eye(27, dtype=torch.float64)
    joints = [
        [forward_kinematics(moved(state, sign * row), shape).joints_m for row in step]
        for sign in (1, -1)
    ]
    difference = torch.cat(joints[0]) - torch.cat(joints[1])
    expected = ((n * difference).sum(-1) / 2e-6).T[None]
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


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


@cache
def seen_in(row: int) -> SeenPoints:
    scene = sample().cut(FRAMES[row])
    return seen_points(nearest_surface()(scene.depth_m[0], scene.k))


def refined(state: Tensor, row: int, settings: Refinement = SETTINGS) -> Tensor:
    shape = default_hand_shape()
    return refine(state, state[:, 6:], seen_in(row), shape, hand_surface(shape), settings)


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


def test_more_steps_come_nearer() -> None:
    start = disturbed(0, 1)
    one, five = (refinement(iterations=n) for n in (1, 5))
    assert (
        errors_mm(refined(start, 0, five), 0).mean() < errors_mm(refined(start, 0, one), 0).mean()
    )


def nothing_seen() -> SeenPoints:
    """No point of a hand, and no background that a finger could stick out over."""
    seen = seen_in(0)
    return replace(seen, points_m=torch.zeros(0, 3), nearest_px=torch.zeros(0, 0, 2))


def beside(state: Tensor, x: float) -> SeenPoints:
    """Points at the joints, moved aside."""
    joints = forward_kinematics(state, default_hand_shape()).joints_m[0]
    return replace(nothing_seen(), points_m=joints + torch.tensor([x, 0.0, 0.0]))


def test_nothing_seen_leaves_the_state_as_it_is_whatever_the_prior_says() -> None:
    state, shape = disturbed(0, 0), default_hand_shape()
    prior = true_states()[:1, 6:]
    for seen in (nothing_seen(), beside(state, 0.5)):
        found = refine(state, prior, seen, shape, hand_surface(shape), SETTINGS)
        assert torch.equal(found, state)


def test_points_of_nothing_near_are_left_alone() -> None:
    """Points farther than the reach from the surface are no part of the hand."""
    state, shape = true_states()[:1], default_hand_shape()
    seen = beside(state, 0.14)
    middle = forward_kinematics(state, shape).joints_m.mean(1)
    assert points_around(seen, middle, 500)[1].any()
    settings = refinement(reach_m=1e-3)
    found = refine(state, state[:, 6:], seen, shape, hand_surface(shape), settings)
    torch.testing.assert_close(found, state, atol=1e-6, rtol=0)
    # What decides nothing leaves the angles to the prior, and the hand where it is.
    start, prior = disturbed(0, 0), true_states()[:1, 6:]
    found = refine(start, prior, beside(start, 0.14), shape, hand_surface(shape), settings)
    torch.testing.assert_close(found[:, :6], start[:, :6], atol=1e-6, rtol=0)
    torch.testing.assert_close(found[:, 6:], clamp_to_joint_limits(prior), atol=1e-5, rtol=0)


def test_hypotheses_do_not_know_of_each_other() -> None:
    """One that is no number and one that sees nothing among those that do."""
    shape = default_hand_shape()
    refiner = TorchRefiner(shape)
    states = torch.cat([disturbed(0, seed) for seed in range(5)])
    states[1] = torch.nan
    states[3, 0] += 1.0
    found = refiner(states, states[:, 6:], seen_in(0), SETTINGS)
    assert torch.equal(found[3], states[3]) and found[1].isnan().all()
    for row in (0, 2, 4):
        alone = refiner(states[row][None], states[row, None, 6:], seen_in(0), SETTINGS)
        torch.testing.assert_close(found[row], alone[0], atol=1e-5, rtol=0)
        assert not torch.equal(found[row], states[row])
    assert refiner(states[:0], states[:0, 6:], seen_in(0), SETTINGS).shape == (0, 27)


def joints_of(states: Tensor) -> Tensor:
    return forward_kinematics(states, default_hand_shape()).joints_m


def off_mm(states: Tensor, points: Tensor) -> Tensor:
    return 1e3 * (joints_of(states) - points).norm(dim=-1).mean(-1)


def test_landmarks_alone_bring_the_hand_to_them() -> None:
    refiner = TorchRefiner(default_hand_shape())
    truth = joints_of(true_states()[0][None])[0]
    starts = torch.cat([disturbed(0, seed) for seed in range(4)])
    marks = Keypoints(truth, torch.full((21,), 0.002))
    settings = refinement(iterations=15, angle_rad=2.0)
    found = refiner(starts, starts[:, 6:], nothing_seen(), settings, marks)
    assert (off_mm(starts, truth) > 8).all()
    assert (off_mm(found, truth) < 1.5).all()


def test_each_hypothesis_may_have_landmarks_of_its_own() -> None:
    refiner = TorchRefiner(default_hand_shape())
    starts, goals = disturbed(0, 0).repeat(2, 1), joints_of(true_states()[:2])
    marks = Keypoints(goals, torch.full((2, 21), 0.003))
    found = refiner(starts, starts[:, 6:], nothing_seen(), refinement(iterations=25), marks)
    assert off_mm(found, goals)[0] < off_mm(starts, goals)[0] / 3
    assert off_mm(found, goals)[1] < off_mm(starts, goals)[1] / 2


def test_unknown_landmarks_count_as_none_and_a_wrong_one_little() -> None:
    refiner = TorchRefiner(default_hand_shape())
    start, seen = disturbed(0, 0), seen_in(0)
    plain = refiner(start, start[:, 6:], seen, SETTINGS)
    points, sigma = joints_of(start)[0] + 0.05, torch.full((21,), torch.inf)

    def with_landmarks() -> torch.Tensor:
        return refiner(start, start[:, 6:], seen, SETTINGS, Keypoints(points, sigma))

    # Rows of zeros may be summed in another order than none.
    torch.testing.assert_close(with_landmarks(), plain, atol=1e-5, rtol=0)
    sigma[3] = 0.005
    points[3] = torch.nan
    torch.testing.assert_close(with_landmarks(), plain, atol=1e-5, rtol=0)
    points[3] = 0.3
    assert (off_mm(with_landmarks(), joints_of(plain)[0]) < 1).all()


@pytest.mark.parametrize(
    ("key", "value"), [("iterations", -1), ("point_m", -0.01), ("angle_rad", "wide")]
)
def test_impossible_settings_are_refused(key: str, value: object) -> None:
    with pytest.raises(ToftrackError, match=f"^refine.{key}={value} "):
        refinement(**{key: value})
