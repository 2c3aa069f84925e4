"""Regions of joints: axes that follow from the joints, and what lies inside."""

import numpy as np
import pytest

from toftrack.hand.regions import REGION_90, in_region_90, joint_axes

RNG = np.random.default_rng(0)


def hand_like(count: int = 5) -> np.ndarray:
    """(T, 21, 3) joints before a camera."""
    return RNG.normal(0, 0.05, (count, 21, 3)) + (0.0, 0.0, 0.5)


def test_axes_are_orthonormal_and_the_first_points_away_from_the_camera() -> None:
    joints = hand_like()
    axes = joint_axes(joints)
    np.testing.assert_allclose(axes @ axes.swapaxes(-1, -2), np.eye(3) + 0 * axes, atol=1e-9)
    ray = joints / np.linalg.norm(joints, axis=-1, keepdims=True)
    np.testing.assert_allclose(axes[..., 0, :], ray)


def test_the_second_axis_is_along_the_bone_that_ends_at_the_joint() -> None:
    joints = np.tile([0.0, 0.0, 0.5], (21, 1))
    joints[5:9, 1] = [-0.08, -0.12, -0.15, -0.17]  # the index finger, upwards
    joints[9, 0] = 0.08  # the middle finger's knuckle, to the right of the wrist
    axes = joint_axes(joints)
    assert axes[7, 1] @ [0, -1, 0] > 0.9 and abs(axes[7, 1] @ joints[7]) < 1e-9
    assert axes[0, 1] @ [1, 0, 0] > 0.9


def test_a_finger_that_points_at_the_camera_has_axes_nevertheless() -> None:
    joints = hand_like(1)[0]
    joints[8] = 0.9 * joints[7]
    axes = joint_axes(joints)[8]
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)


def test_the_region_holds_nine_of_ten_gaussian_errors() -> None:
    joints = np.tile(hand_like(1), (2000, 1, 1))
    sigma = np.tile(RNG.uniform(0.002, 0.02, (21, 3)), (2000, 1, 1))
    steps = RNG.normal(size=joints.shape) * sigma
    true = joints + np.einsum("tja,tjab->tjb", steps, joint_axes(joints))
    assert in_region_90(joints, sigma, true).mean() == pytest.approx(0.9, abs=0.01)


def test_the_region_ends_along_each_axis_where_it_should() -> None:
    joints, sigma = hand_like(1)[0], np.tile([0.01, 0.002, 0.005], (21, 1))
    for axis in range(3):
        border = REGION_90 * sigma[:, axis, None] * joint_axes(joints)[:, axis]
        assert in_region_90(joints, sigma, joints + 0.99 * border).all()
        assert not in_region_90(joints, sigma, joints - 1.01 * border).any()


def test_where_nothing_is_known_nothing_is_inside() -> None:
    joints = hand_like()
    assert not in_region_90(joints, np.full(joints.shape, np.nan), joints).any()
    assert not in_region_90(np.nan * joints, np.ones(joints.shape), joints).any()
