"""What speaks against joints: the compiled sum against the reference."""

from __future__ import annotations

import pytest
import torch

from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, forward_kinematics
from toftrack.refinement import penalty, penalty_numba
from toftrack.refinement.gauss_newton import Keypoints

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("length_m", [0.16, 0.21])
@pytest.mark.parametrize("overlap", [0.0, 2.0])
@pytest.mark.parametrize("with_keypoints", [False, True])
def test_both_say_the_same_of_any_hand(
    length_m: float, overlap: float, with_keypoints: bool
) -> None:
    draw = torch.Generator().manual_seed(0)
    states = torch.randn(40, 27, generator=draw)
    low, high = torch.tensor(ANGLE_LIMITS).unbind(1)
    states[:, 6:] = low + (high - low) * torch.rand(40, 21, generator=draw)
    joints = forward_kinematics(states, default_hand_shape(length_m)).joints_m
    keypoints = None
    if with_keypoints:
        sigma = 0.004 + 0.02 * torch.rand(21, generator=draw)
        sigma[7] = torch.inf
        keypoints = Keypoints(joints[0] + 0.02 * torch.randn(21, 3, generator=draw), sigma)
    found = penalty_numba.joints_penalty(joints, length_m, overlap, keypoints, 0.7)
    expected = penalty.joints_penalty(joints, length_m, overlap, keypoints, 0.7)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)
    assert bool((found > 0).any()) == bool(overlap or with_keypoints)
