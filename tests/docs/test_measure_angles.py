"""docs/measure_angles.py, and what docs/formats.md says of the joint angles."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from helpers.tracking import ROOT

import toftrack
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import forward_kinematics

sys.path.insert(0, str(ROOT / "docs"))
from measure_angles import bent_deg, every_neighbour


def joints(**angles_rad: float) -> np.ndarray:
    """(1, 21, 3) of a right hand at the origin, in its own axes."""
    state = torch.zeros(1, 27)
    for name, angle in angles_rad.items():
        state[0, 6 + toftrack.ANGLE_NAMES.index(name)] = angle
    return forward_kinematics(state, default_hand_shape()).joints_m.numpy()


def test_what_is_measured_is_the_flexion_of_the_outer_joints() -> None:
    found = bent_deg(joints(ring_pip_flexion=1.0, little_dip_flexion=0.5, thumb_ip_flexion=-0.2))
    assert found.shape == (1, 5, 3)
    outer = found[0, [3, 4, 0, 1], [1, 2, 2, 1]]
    assert outer == pytest.approx(np.degrees([1.0, 0.5, 0.2, 0.0]), abs=0.1)


def test_an_angle_is_ok_where_its_three_joints_are() -> None:
    ok = np.ones((1, 21), bool)
    ok[0, toftrack.JOINT_NAMES.index("index_dip")] = False
    assert np.argwhere(~every_neighbour(ok)[0]).tolist() == [[1, 1], [1, 2]]


@pytest.mark.parametrize(
    ("angle", "tip", "axis", "sign"),
    [
        ("index_mcp_abduction", "index_tip", 0, 1),  # towards the thumb
        ("little_mcp_abduction", "little_tip", 0, 1),
        ("index_pip_flexion", "index_tip", 2, -1),  # out of the palm
        ("thumb_cmc_abduction", "thumb_tip", 2, -1),
        ("thumb_cmc_abduction", "thumb_tip", 1, 1),  # back to the wrist
        ("thumb_cmc_flexion", "thumb_tip", 0, -1),  # towards the fingers
        ("thumb_ip_flexion", "thumb_tip", 0, -1),
    ],
)
def test_positive_angles_turn_as_the_page_says(angle: str, tip: str, axis: int, sign: int) -> None:
    moved = (joints(**{angle: 0.3}) - joints())[0, toftrack.JOINT_NAMES.index(tip)]
    assert sign * moved[axis] > 0.004
