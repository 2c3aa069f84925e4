"""Poses to train on: natural, within the limits, and the same again from a seed."""

from __future__ import annotations

import pytest
import torch

from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, JOINT_NAMES, forward_kinematics
from toftrack.pose_space.data import natural_poses as poses

pytestmark = pytest.mark.usefixtures("one_thread")

LOW, HIGH = torch.tensor(ANGLE_LIMITS).unbind(1)
N = 2000


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def tips(angles: torch.Tensor) -> torch.Tensor:
    """(N, 5, 3) of the default hand, thumb first."""
    state = torch.cat((torch.zeros(len(angles), 6), angles), 1)
    joints = forward_kinematics(state, default_hand_shape()).joints_m
    return joints[:, [i for i, name in enumerate(JOINT_NAMES) if name.endswith("_tip")]]


def test_poses_are_within_the_limits_and_of_all_kinds() -> None:
    angles = poses.sample_poses(N, generator())
    assert angles.shape == (N, 21) and angles.isfinite().all()
    assert (angles >= LOW).all() and (angles <= HIGH).all()
    # Fingers straight and curled, and each without its neighbour.
    bent = angles[:, 5:].unflatten(1, (4, 4))[:, :, 1:].sum(2)
    straight, curled = bent < 0.7, bent > 3.0
    for finger in range(4):
        assert 0.1 < straight[:, finger].float().mean() < 0.8
        assert 0.1 < curled[:, finger].float().mean() < 0.8
    alone = (straight.sum(1) == 1) & (curled.sum(1) == 3)
    assert alone.sum() > N / 100
    assert curled.all(1).sum() > N / 100 and straight.all(1).sum() > N / 100


def test_a_seed_gives_the_same_poses_and_another_one_others() -> None:
    one, two = (poses.sample_poses(50, generator(seed)) for seed in (3, 3))
    assert torch.equal(one, two)
    assert not torch.equal(one, poses.sample_poses(50, generator(4)))


def test_thumb_and_finger_of_pinches_touch() -> None:
    flat = torch.zeros(400, 21)
    pinched = poses._pinching(flat, generator())
    ends = tips(pinched)
    gaps = (ends[:, 1:3] - ends[:, :1]).norm(dim=2).amin(1)
    assert float(gaps.max()) < 0.0201
    # One finger comes to the thumb, the others stay as they are.
    moved = (pinched != flat)[:, 5:].unflatten(1, (4, 4)).any(2)
    assert (moved.sum(1) == 1).all() and not moved[:, 2:].any()
    assert moved[:, 0].any() and moved[:, 1].any(), "index and middle finger"


def test_the_recorded_poses_are_those_of_hands() -> None:
    recorded = poses.recorded_poses()
    assert recorded.shape[1] == 21 and len(recorded) > 100
    # Recorded hands bend a little beyond what clinics tabulate.
    assert (recorded > LOW - 0.35).all() and (recorded < HIGH + 0.35).all()


def test_the_poses_that_are_kept_are_the_sampled_ones() -> None:
    """They are kept since drawing them takes a second: if this fails, keep the new ones."""
    recorded = poses.recorded_poses()
    kept = poses.natural_poses()
    assert torch.equal(kept[: len(recorded)], recorded)
    sampled = poses.sample_poses(len(recorded), torch.Generator().manual_seed(0))
    torch.testing.assert_close(kept[len(recorded) :], sampled)
