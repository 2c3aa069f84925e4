"""The fit of the hand's shape: it finds hands, says how surely, and thinks again."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from helpers.detection import detection_of
from helpers.tracking import make_tracker, sample
from reference.refinement import moved

from toftrack.detector.detection import Detection
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, HandShape, default_hand_shape
from toftrack.hand.shape_space import POPULATION_SIGMA, shape_derivatives, shaped
from toftrack.hand.skeleton import forward_kinematics
from toftrack.refinement import shape_fit
from toftrack.refinement.gauss_newton import Keypoints
from toftrack.refinement.shape_fit import ShapeEstimate, first_shape, keypoints_system

KEYPOINTS_OFF = torch.tensor(shape_fit.KEYPOINTS_OFF)
BETWEEN_FINGERS = torch.tensor([0.05, 0.06, 0.0, 0.0, -0.05, 0.04])


def poses(count: int, seed: int = 0) -> torch.Tensor:
    """(count, 27) hands in front of the camera, bent and turned differently."""
    generator = torch.Generator().manual_seed(seed)
    states = torch.zeros(count, 27)
    states[:, :3] = torch.tensor([0.0, 0.08, 0.5])
    states[:, 3:6] = 0.5 * torch.randn(count, 3, generator=generator)
    states[:, 6:] = 0.5 * torch.rand(count, 21, generator=generator)
    return states


def detection(shape: HandShape, state: torch.Tensor, sigma_m: float = 0.004) -> Detection:
    """What networks would say that see every joint of a hand (1, 27), and err as they do."""
    joints = forward_kinematics(state, shaped(shape, KEYPOINTS_OFF)).joints_m[0]
    log_size = math.log(shape.hand_length_m / DEFAULT_HAND_LENGTH_M)
    keypoints = Keypoints(joints, torch.full((21,), sigma_m))
    return replace(detection_of(state, log_size, shape.side), keypoints=keypoints)


def fitted(
    belief: ShapeEstimate, shape: HandShape, states: torch.Tensor, sigma_m: float = 0.004
) -> ShapeEstimate:
    """After believed estimates of a hand, whose poses are right: so many frames of each pose that
    one is looked at.
    """
    first = default_hand_shape(side=shape.side)
    for state in states[:, None].repeat_interleave(shape_fit.EVERY, 0):
        seen = detection(shape, state, sigma_m)
        belief = shape_fit.contradicted(belief, seen, first)
        applied = torch.tensor(belief.applied)
        used = shaped(first, applied)
        keypoints = Keypoints(seen.keypoints.points_m, seen.keypoints.sigma_m.clamp(min=0.008))
        belief = shape_fit.learned(
            belief,
            state,
            used,
            shape_derivatives(first, applied),
            seen,
            keypoints,
            first,
            partial(forward_kinematics, shape=used),
        )
    return belief


@pytest.mark.parametrize("side", ["right", "left"])
def test_keypoints_say_by_how_much_a_hand_is_another(side: str) -> None:
    first, state = default_hand_shape(side=side), poses(1)
    none = torch.zeros(6)
    joints = forward_kinematics(state, shaped(first, 0.2 * BETWEEN_FINGERS)).joints_m[0]
    keypoints = Keypoints(joints, torch.full((21,), 0.002))
    pose = forward_kinematics(state, first)
    said = keypoints_system(pose, first, shape_derivatives(first, none), keypoints)
    information, vector = (torch.from_numpy(one).float() for one in said)
    # Thickness moves no joint.
    assert information[3].abs().max() < 1e-3 * information.diagonal().max()
    assert torch.linalg.eigvalsh(information).min() > -1e-3 * information.diagonal().max()
    seen = [0, 1, 4, 5]
    precision = information + torch.diag(torch.tensor([1e-3, 1e-3, 1e3, 1e3, 1e-3, 1e-3]))
    found = torch.linalg.solve(precision, vector)
    torch.testing.assert_close(found[seen], 0.2 * BETWEEN_FINGERS[seen], atol=0.006, rtol=0.1)


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_joints_move_as_their_derivatives_say(side: str) -> None:
    shape, state = default_hand_shape(side=side), poses(1)

    def joints_after(step: torch.Tensor) -> torch.Tensor:
        return forward_kinematics(moved(state, step[None]), shape).joints_m.flatten()

    found = shape_fit._joint_jacobian(forward_kinematics(state, shape), shape)
    expected = torch.func.jacfwd(joints_after)(torch.zeros(27))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_hand_is_found_in_different_poses_and_the_fit_says_how_surely() -> None:
    shape = shaped(default_hand_shape(), BETWEEN_FINGERS)
    belief = fitted(first_shape(), shape, poses(16))
    applied = shaped(default_hand_shape(), torch.tensor(belief.applied))
    assert applied.hand_length_m == pytest.approx(shape.hand_length_m, rel=0.04)
    off = (applied.bone_lengths_m.sum(1) / shape.bone_lengths_m.sum(1)).log()
    before = default_hand_shape(DEFAULT_HAND_LENGTH_M * math.exp(0.05)).bone_lengths_m.sum(1)
    assert off.square().mean() < 0.6 * (before / shape.bone_lengths_m.sum(1)).log().square().mean()
    sigma = belief.summary().sigma
    assert sigma[0] < 0.5 * POPULATION_SIGMA[0]  # what is alike in all frames stays
    assert sigma[3] == pytest.approx(POPULATION_SIGMA[3], rel=1e-3)  # joints tell no thickness


def test_one_pose_seen_again_and_again_counts_once() -> None:
    shape, state = default_hand_shape(0.17), poses(1)
    once = fitted(first_shape(), shape, state)
    often = fitted(first_shape(), shape, state.repeat(30, 1))
    assert often.poses == pytest.approx(once.poses)
    assert often.covariance[0, 0] == pytest.approx(float(once.covariance[0, 0]), rel=0.1)
    other = fitted(first_shape(), shape, poses(30))
    assert other.poses > 5 * once.poses
    assert other.covariance[0, 0] < once.covariance[0, 0]


def test_a_hand_that_is_hardly_seen_says_little() -> None:
    shape = default_hand_shape(0.16)
    assert fitted(first_shape(), shape, poses(3), sigma_m=0.03).poses == 0
    sure, unsure = (fitted(first_shape(), shape, poses(3), sigma) for sigma in (0.004, 0.007))
    assert unsure.covariance[0, 0] > 1.5 * sure.covariance[0, 0]


def test_a_hand_is_frozen_when_it_is_certain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shape_fit, "CERTAIN_POSES", 3.9)
    shape = default_hand_shape(0.18)
    belief = fitted(first_shape(), shape, poses(10))
    assert belief.frozen and belief.poses == pytest.approx(4, rel=1e-3)
    extended = default_hand_shape(0.185)
    assert fitted(belief, extended, poses(5, seed=1)).applied == belief.applied


def test_another_person_s_hand_is_noticed_and_fitted_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shape_fit, "CERTAIN_POSES", 6)
    belief = fitted(first_shape(), default_hand_shape(0.20), poses(12))
    assert belief.frozen
    after = fitted(belief, default_hand_shape(0.15), poses(14, seed=1))
    applied = shaped(default_hand_shape(), torch.tensor(after.applied))
    assert applied.hand_length_m == pytest.approx(0.15, rel=0.04)


def test_a_single_odd_frame_reopens_nothing() -> None:
    belief = fitted(first_shape(), default_hand_shape(0.19), poses(12))
    once = fitted(belief, default_hand_shape(0.15), poses(1, seed=1))
    assert once.poses >= belief.poses


def test_the_network_s_length_is_applied_until_estimates_say_better() -> None:
    first = default_hand_shape()
    said = shape_fit.with_network_length(first_shape(), 0.16, first)
    assert shaped(first, torch.tensor(said.applied)).hand_length_m == pytest.approx(0.16, rel=1e-4)
    for absurd in (1e-3, 10.0):
        applied = shape_fit.with_network_length(first_shape(), absurd, first).applied
        assert abs(applied[0]) <= 3 * POPULATION_SIGMA[0]
    known = fitted(first_shape(), default_hand_shape(0.18), poses(3))
    assert shape_fit.with_network_length(known, 0.15, first) is known


def test_the_shape_in_use_changes_in_steps_only() -> None:
    belief = fitted(first_shape(), default_hand_shape(0.18), poses(6))
    nearly = fitted(belief, default_hand_shape(0.1803), poses(3, seed=1))
    assert nearly.applied == belief.applied and (nearly.mean != belief.mean).any()


def test_only_auto_is_fitted() -> None:
    fixed, scene = make_tracker("hand.shape=default"), sample()
    fixed.step(scene.depth_m[0], scene.k)
    assert fixed.shape.hand_length_m == pytest.approx(DEFAULT_HAND_LENGTH_M)
    assert not fixed.model.fits and fixed.hands.fitted[0].fitted is None
    assert make_tracker().model.fits
    fitted_hand = make_tracker("hand.side=left").hands.fitted[0]
    assert fitted_hand.side == "left" and fitted_hand.fitted is None, "nothing was fitted yet"
