"""The compiled joints of OpenXR are those of the reference."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toftrack.hand.conventions import openxr_hand_compiled
from toftrack.hand.openxr import openxr_hand, openxr_rig
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import forward_kinematics


@pytest.mark.parametrize("side", ["right", "left"])
def test_compiled_and_reference_agree(side: str) -> None:
    shape = default_hand_shape(side=side)
    rig = openxr_rig(shape)
    generator = torch.Generator().manual_seed(0)
    states = torch.rand((50, 27), generator=generator, dtype=torch.float64) * 3 - 1.5
    states[0] = 0
    states[1, 3:6] = torch.tensor([torch.pi, 0, 0])
    joints = forward_kinematics(states, shape.to(torch.float64)).joints_m.numpy()
    for state, placed in zip(states.numpy(), joints, strict=True):
        wanted = openxr_hand(placed, state, rig)
        found = openxr_hand_compiled(placed, state, rig)
        np.testing.assert_allclose(found.position_m, wanted.position_m, atol=1e-9)
        same = np.abs((found.orientation * wanted.orientation).sum(1))  # where w = 0, q is -q
        np.testing.assert_allclose(same, 1, atol=1e-9)
        assert (found.orientation[:, 3] >= 0).all()
        np.testing.assert_array_equal(found.radius_m, wanted.radius_m)
