"""Coverage: how often the regions of joints hold the truth."""

from __future__ import annotations

import numpy as np
import pytest

from toftrack.frames import Truth
from toftrack.output.measures import coverage


def case() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joints that are 10 mm off; standard deviations; which are hidden: 4 frames."""
    joints = np.random.default_rng(0).normal(0, 0.05, (4, 21, 3)) + (0, 0, 0.5)
    return joints, np.full(joints.shape, 0.01), np.zeros((4, 21), bool)


def truth_of(joints: np.ndarray, hidden: np.ndarray | None, seen: int = 4) -> Truth:
    off = np.zeros_like(joints)
    off[..., 0] = 0.01
    visible = np.arange(4) < seen
    return Truth(joints + off, visible, visible, None, None if hidden is None else ~hidden)


def test_shares_are_of_visible_frames_and_of_hidden_joints() -> None:
    joints, sigma, hidden = case()
    hidden[:, :3] = True
    sigma[0, 0] = sigma[1, 5] = 0.001
    sigma[3] = 0.001  # the hand is out of view
    found = coverage(joints, sigma, truth_of(joints, hidden, seen=3))
    assert found["in_region_90_pct"] == pytest.approx(100 * (1 - 2 / 63))
    assert found["hidden_in_region_90_pct"] == pytest.approx(100 * (1 - 1 / 9))
    assert found["without_region_pct"] == 0


def test_joints_without_a_region_are_counted_apart() -> None:
    joints, sigma, _ = case()
    sigma[0], joints[1] = np.nan, np.nan
    found = coverage(joints, sigma, truth_of(joints, None))
    assert list(found.values()) == [100.0, None, 50.0]


def test_without_a_visible_hand_there_is_no_figure() -> None:
    joints, sigma, hidden = case()
    assert set(coverage(joints, sigma, truth_of(joints, hidden, seen=0)).values()) == {None}
