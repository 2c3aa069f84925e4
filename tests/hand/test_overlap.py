"""Fingers in one another are noticed, and fingers that lie as fingers do are not."""

import math

import pytest
import torch

from toftrack.hand.overlap import finger_overlap, overlap_of_each
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, default_hand_shape
from toftrack.hand.skeleton import ANGLE_NAMES, forward_kinematics
from toftrack.pose_space.data.pose_data import basic_pose


def joints(pose: str, size: float = 1.0, **degrees: float) -> torch.Tensor:
    """(1, 21, 3) of a basic pose, some of its angles changed, of a hand `size` times as large."""
    state = torch.zeros(1, 27)
    state[0, 6:] = basic_pose(pose).float()
    for name, value in degrees.items():
        state[0, 6 + ANGLE_NAMES.index(name)] = math.radians(value)
    shape = default_hand_shape(DEFAULT_HAND_LENGTH_M * size)
    return forward_kinematics(state, shape).joints_m


@pytest.mark.parametrize(("pose", "most"), [("palm", 0.01), ("gun", 0.15), ("fist", 0.5)])
def test_hands_as_people_hold_them_hardly_overlap(pose: str, most: float) -> None:
    assert float(finger_overlap(joints(pose), DEFAULT_HAND_LENGTH_M)) < most


@pytest.mark.parametrize("size", [0.8, 1.15])
def test_two_straight_fingers_on_one_seen_finger_overlap_at_any_size(size: float) -> None:
    onto = {"index_mcp_abduction": -12.0, "middle_mcp_abduction": 12.0}
    assert set(onto) <= set(ANGLE_NAMES)
    each = overlap_of_each(joints("palm", size, **onto), DEFAULT_HAND_LENGTH_M * size)[0]
    assert float(each[1]) > 1 and float(each[2]) > 1, "index and middle finger"
    assert float(each[0]) < 0.1 and float(each[4]) < 0.1, "not the thumb, not the little finger"
    total = finger_overlap(joints("palm", size, **onto), DEFAULT_HAND_LENGTH_M * size)
    torch.testing.assert_close(each.sum(), 2 * total[0])


def test_bent_fingers_may_be_closer_than_straight_ones() -> None:
    close = joints("palm", index_mcp_abduction=-9.0, middle_mcp_abduction=9.0)
    bent = {f"{finger}_{joint}_flexion": angle for finger in ("index", "middle")
            for joint, angle in (("mcp", 88.0), ("pip", 100.0), ("dip", 50.0))}  # fmt: skip
    curled = joints("palm", index_mcp_abduction=-9.0, middle_mcp_abduction=9.0, **bent)
    straight, squeezed = (
        float(finger_overlap(hand, DEFAULT_HAND_LENGTH_M)) for hand in (close, curled)
    )
    assert straight > 2 * squeezed
