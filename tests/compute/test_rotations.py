"""Rotations: the same as roma's, at every angle."""

import math

import pytest
import roma
import torch
from torch import Tensor

from toftrack.compute import rotations


@pytest.fixture(params=[torch.float32, torch.float64])
def rotvecs(request: pytest.FixtureRequest) -> Tensor:
    """(2, N, 3) of all lengths from nothing to more than a turn."""
    generator = torch.Generator().manual_seed(0)
    way = torch.randn(2, 400, 3, generator=generator, dtype=request.param)
    lengths = [0, 1e-9, 1e-6, 1e-3, 0.2, 1, 3, math.pi - 1e-4, math.pi, 4, 7]
    length = way.new_tensor(lengths).repeat(40)[:400, None]
    return way / way.norm(dim=-1, keepdim=True) * length


def test_conversions_are_romas(rotvecs: Tensor) -> None:
    matrices = rotations.rotvec_to_rotmat(rotvecs)
    torch.testing.assert_close(matrices, roma.rotvec_to_rotmat(rotvecs))
    torch.testing.assert_close(
        rotations.rotmat_to_rotvec(matrices), roma.rotmat_to_rotvec(matrices)
    )
    quaternions = roma.rotvec_to_unitquat(rotvecs)
    for name in ("unitquat_to_rotvec", "unitquat_to_rotmat"):
        ours, theirs = getattr(rotations, name), getattr(roma, name)
        torch.testing.assert_close(ours(quaternions), theirs(quaternions))


def test_products_are_romas(rotvecs: Tensor) -> None:
    first, second = rotvecs[0], rotvecs[1].flip(0)
    for turned in ((first, second), (first, second[:1], first.flip(0))):
        found = rotations.rotvec_composition(*turned)
        torch.testing.assert_close(found, roma.rotvec_composition(turned))


def test_two_columns_become_a_rotation(rotvecs: Tensor) -> None:
    columns = torch.stack((rotvecs[0], rotvecs[1].roll(1, 0)), -1)[6:300] + 0.1
    found = rotations.special_gramschmidt(columns)
    torch.testing.assert_close(found, roma.special_gramschmidt(columns))


def test_derivatives_are_finite_and_romas(rotvecs: Tensor) -> None:
    def slope(function: object) -> Tensor:
        given = rotvecs[0].clone().requires_grad_()
        function(given).square().sum().backward()  # type: ignore[operator]
        assert given.grad is not None
        return given.grad

    there = rotvecs[1]
    torch.testing.assert_close(
        slope(lambda given: rotations.rotvec_composition(there, given)),
        slope(lambda given: roma.rotvec_composition((there, given))),
    )
    ours = slope(lambda given: rotations.rotvec_to_rotmat(given)[..., 0])
    torch.testing.assert_close(ours, slope(lambda given: roma.rotvec_to_rotmat(given)[..., 0]))
