"""Refinement: its derivatives, its agreement with the reference, and what it does to poses."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import roma
import torch
from helpers.settings import nearest_surface, refinement
from helpers.tracking import sample
from reference.refinement import moved, refine
from torch import Tensor

from toftrack.evaluation.trust import TIPS
from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import hand_surface, parted
from toftrack.pose_space.base import clamp_to_joint_limits
from toftrack.pose_space.inverse_kinematics import fit_angles
from toftrack.refinement.gauss_newton import Keypoints, Refinement
from toftrack.refinement.gauss_newton_numba import Refiner
from toftrack.refinement.seen_points import SeenPoints, seen_points
from toftrack.render.reference import render_range_images
from toftrack.render.segmentation import Observation

K = torch.tensor([[220.0, 0.0, 88.0], [0.0, 220.0, 72.0], [0.0, 0.0, 1.0]])
SETTINGS = refinement()
SPREAD = torch.tensor([0.005] * 3 + [0.08] * 24)
FRAMES = range(0, 100, 9)
SHAPE = default_hand_shape()
HANDS = Refiner(SHAPE)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


# Beside the reference.


def seen_hand(shape: HandShape, seed: int, n: int = 1) -> tuple[Tensor, SeenPoints, Tensor]:
    """A random true state, what the camera sees of it, and n states near it to start from."""
    state, g = torch.zeros(1, 27), generator(seed)
    state[0, :3] = torch.tensor([0.0, 0.05, 0.45])
    state[0, 3:] = 0.2 * torch.randn(24, generator=g)
    hand, _ = parted(hand_surface(shape).pose(forward_kinematics(state, shape)))
    depth = render_range_images(hand, K, 144, 176)[0]
    observation = Observation(depth, depth > 0, torch.zeros_like(depth, dtype=torch.bool), K, 0.4)
    return state, seen_points(observation), state + SPREAD * torch.randn(n, 27, generator=g)


def nothing_in(seen: SeenPoints) -> SeenPoints:
    """No point of a hand, and no background that a finger could stick out over."""
    return replace(seen, points_m=torch.zeros(0, 3), beside=torch.zeros(0, 0, dtype=torch.int32))


def check_agreement(
    shape: HandShape,
    starts: Tensor,
    seen: SeenPoints,
    settings: Refinement = SETTINGS,
    marks: Keypoints | None = None,
) -> Tensor:
    found = Refiner(shape)(starts, starts[:, 6:], seen, settings, marks)
    expected = refine(starts, starts[:, 6:], seen, shape, settings, marks)
    assert found.dtype == torch.float32 and found.shape == starts.shape
    joints = [forward_kinematics(states, shape).joints_m for states in (found, expected)]
    torch.testing.assert_close(*joints, atol=1e-5, rtol=0)
    torch.testing.assert_close(Refiner(shape).joints(found), joints[0], atol=1e-5, rtol=0)
    return found


@pytest.mark.parametrize("side", ["right", "left"])
def test_it_agrees_with_the_reference_on_a_recording(side: str) -> None:
    for frame in (0, 36, 72):
        scene = sample().cut(frame)
        if side == "left":
            scene = scene.mirrored()
        seen = seen_points(nearest_surface()(scene.depth_m[0], scene.k))
        starts = torch.zeros(3, 27)
        starts[:, :3] = torch.from_numpy(scene.joints_m[0, 0])
        starts += SPREAD * torch.randn(3, 27, generator=generator(frame))
        found = check_agreement(default_hand_shape(side=side), starts, seen)
        assert ((found - starts).abs().amax(1) > 0.01).all()


@pytest.mark.parametrize("own", [False, True])
def test_it_agrees_with_the_reference_about_keypoints(own: bool) -> None:
    truth, seen, starts = seen_hand(SHAPE, 5, n=3)
    g = generator(6)
    points = HANDS.joints(truth)[0] + 0.004 * torch.randn(21, 3, generator=g)
    sigma = 0.002 + 0.02 * torch.rand(21, generator=g)
    sigma[4], sigma[8], points[12, 1] = math.inf, 0.0, math.nan
    if own:
        points, sigma = points + 0.01 * torch.arange(3)[:, None, None], sigma.repeat(3, 1)
    without = HANDS(starts, starts[:, 6:], seen, SETTINGS)
    for what in (seen, replace(seen, points_m=torch.zeros(0, 3))):
        found = check_agreement(SHAPE, starts, what, marks=Keypoints(points, sigma))
        assert (off_mm(found, HANDS.joints(without)) > 0.1).all()


@pytest.mark.parametrize("z", [-0.4, 0.0, 0.03])
def test_hands_at_and_behind_the_camera_agree_too(z: float) -> None:
    _, seen, start = seen_hand(SHAPE, 6)
    start[0, 2] = z
    there = replace(seen, points_m=seen.points_m + torch.tensor([0.0, 0.0, z - 0.45]))
    found = check_agreement(SHAPE, start, there, refinement(iterations=1))
    assert found.isfinite().all()


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1)])
def test_images_of_a_pixel_s_width_do_no_harm(size: tuple[int, int]) -> None:
    hand = torch.ones(size, dtype=torch.bool)
    k = K.clone()
    k[:2, 2] = 0
    start = torch.zeros(1, 27)
    start[0, 1:3] = torch.tensor([0.08, 0.46])
    seen = seen_points(Observation(torch.full(size, 0.45), hand, ~hand, k, 0.45))
    check_agreement(SHAPE, start, seen)


def test_hypotheses_do_not_know_of_each_other() -> None:
    """Together, alone, in threads and in calls at the same time: the same to the last bit."""
    _, seen, starts = seen_hand(SHAPE, 3, n=12)
    starts[1], starts[4, 3] = math.nan, math.inf
    starts[7, 0] += 1.0
    alone = [HANDS(start, start[:, 6:], seen, SETTINGS) for start in starts.split(1)]
    torch.set_num_threads(4)
    with ThreadPoolExecutor(3) as pool:
        calls = [pool.submit(HANDS, starts, starts[:, 6:], seen, SETTINGS) for _ in range(6)]
    for call in calls:
        assert torch.equal(call.result().nan_to_num(), torch.cat(alone).nan_to_num())
    assert alone[1].isnan().all() and not alone[4].isfinite().all()
    assert torch.equal(alone[7], starts[7:8]), "it sees nothing"
    assert HANDS(starts[:0], starts[:0, 6:], seen, SETTINGS).shape == (0, 27)


# In the frames of the recording.


@cache
def true_states() -> Tensor:
    """(T, 27) poses of our hand that lie on the true joints of some frames."""
    joints = torch.from_numpy(sample().cut(*FRAMES).joints_m)
    shape = SHAPE.to(torch.float64)
    angles = fit_angles(joints[:, 1:].unflatten(1, (5, 4)), shape).angles_rad
    states = torch.cat((torch.zeros(len(angles), 6, dtype=torch.float64), angles), 1)
    flat = forward_kinematics(states, shape).joints_m
    rotation, translation = roma.rigid_points_registration(flat, joints)
    states[:, 3:6] = roma.rotmat_to_rotvec(rotation)
    states[:, :3] = translation
    return states.float()


@cache
def seen_in(row: int) -> SeenPoints:
    scene = sample().cut(FRAMES[row])
    return seen_points(nearest_surface()(scene.depth_m[0], scene.k))


def refined(state: Tensor, row: int, settings: Refinement = SETTINGS) -> Tensor:
    return HANDS(state, state[:, 6:], seen_in(row), settings)


def errors_mm(state: Tensor, row: int) -> np.ndarray:
    joints = HANDS.joints(state)[0].numpy()
    return 1e3 * np.linalg.norm(joints - sample().joints_m[FRAMES[row]], axis=-1)


def off_mm(states: Tensor, points: Tensor) -> Tensor:
    return 1e3 * (HANDS.joints(states) - points).norm(dim=-1).mean(-1)


def disturbed(row: int, seed: int) -> Tensor:
    """About 14 mm, 7 degrees and 10 degrees a joint away from the truth."""
    sigma = torch.tensor([0.008] * 3 + [0.07] * 3 + [0.17] * 21)
    change = sigma * torch.randn(27, generator=generator(100 * row + seed))
    state = moved(true_states()[row : row + 1], change[None])
    return torch.cat((state[:, :6], clamp_to_joint_limits(state[:, 6:])), 1)


def test_refinement_brings_a_disturbed_pose_back() -> None:
    errors = []
    for row in range(len(FRAMES)):
        assert errors_mm(true_states()[row : row + 1], row).mean() < 6, "our hand fits the truth"
        for start in (disturbed(row, seed) for seed in range(3)):
            errors.append((errors_mm(start, row), errors_mm(refined(start, row), row)))
    before, after = np.array(errors).swapaxes(0, 1)
    assert after.mean() < 0.6 * before.mean()
    tips = list(TIPS)
    assert after[:, tips].mean() < 0.75 * before[:, tips].mean()
    # Were it as likely to get better as worse, 30 of 36 would come with a probability below 1e-4.
    assert (after.mean(1) < before.mean(1)).sum() >= 30
    one, five = (refined(disturbed(0, 1), 0, refinement(iterations=n)) for n in (1, 5))
    assert errors_mm(five, 0).mean() < errors_mm(one, 0).mean(), "more steps come nearer"


def test_refinement_leaves_the_truth_about_where_it_is() -> None:
    errors = [
        (errors_mm(state, row).mean(), errors_mm(refined(state, row), row).mean())
        for row, state in enumerate(true_states().split(1))
    ]
    before, after = np.mean(errors, 0)
    assert after < before + 2.5


def beside(state: Tensor, x: float) -> SeenPoints:
    """Points at the joints, moved aside."""
    points = HANDS.joints(state)[0] + torch.tensor([x, 0.0, 0.0])
    return replace(nothing_in(seen_in(0)), points_m=points)


def test_nothing_seen_leaves_the_state_as_it_is_whatever_the_prior_says() -> None:
    state, prior = disturbed(0, 0), true_states()[:1, 6:]
    for seen in (nothing_in(seen_in(0)), beside(state, 0.5)):
        assert torch.equal(HANDS(state, prior, seen, SETTINGS), state)


def test_points_of_nothing_near_leave_the_angles_to_the_prior() -> None:
    """Points farther than the reach from the surface are no part of the hand."""
    start, prior = disturbed(0, 0), true_states()[:1, 6:]
    found = HANDS(start, prior, beside(start, 0.14), SETTINGS)
    torch.testing.assert_close(found[:, :6], start[:, :6], atol=1e-6, rtol=0)
    torch.testing.assert_close(found[:, 6:], clamp_to_joint_limits(prior), atol=1e-5, rtol=0)


def test_keypoints_alone_bring_hands_to_them_each_to_its_own() -> None:
    truth, nothing = HANDS.joints(true_states()[:2]), nothing_in(seen_in(0))
    starts = torch.cat([disturbed(0, seed) for seed in range(4)])
    marks = Keypoints(truth[0], torch.full((21,), 0.002))
    settings = refinement(iterations=15, angle_rad=2.0)
    found = HANDS(starts, starts[:, 6:], nothing, settings, marks)
    assert (off_mm(starts, truth[0]) > 8).all() and (off_mm(found, truth[0]) < 1.5).all()
    starts, marks = starts[:1].repeat(2, 1), Keypoints(truth, torch.full((2, 21), 0.003))
    found = HANDS(starts, starts[:, 6:], nothing, refinement(iterations=25), marks)
    assert (off_mm(found, truth) < off_mm(starts, truth) / 2).all()


def test_unknown_keypoints_count_as_none_and_a_wrong_one_little() -> None:
    start, seen = disturbed(0, 0), seen_in(0)
    plain = HANDS(start, start[:, 6:], seen, SETTINGS)
    points, sigma = HANDS.joints(start)[0] + 0.05, torch.full((21,), torch.inf)

    def with_keypoints() -> Tensor:
        return HANDS(start, start[:, 6:], seen, SETTINGS, Keypoints(points, sigma))

    torch.testing.assert_close(with_keypoints(), plain, atol=1e-5, rtol=0)
    sigma[3], points[3] = 0.005, torch.nan
    torch.testing.assert_close(with_keypoints(), plain, atol=1e-5, rtol=0)
    points[3] = 0.3
    assert (off_mm(with_keypoints(), HANDS.joints(plain)[0]) < 1).all()
