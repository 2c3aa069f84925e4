"""Rigid motions: what they mean, and the compiled ones against the reference."""

import math

import numpy as np
import pytest
import roma
import torch
from helpers.programs import python
from helpers.tracking import ROOT
from torch import Tensor

from toftrack.compute import rigid, rigid_numba
from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, forward_kinematics

both = pytest.mark.parametrize(
    "motions", [rigid.MOTIONS, rigid_numba.MOTIONS], ids=["torch", "numba"]
)


def particles(n: int, size: float, seed: int) -> Tensor:
    return size * torch.randn(n, 10, generator=torch.Generator().manual_seed(seed))


@both
def test_an_offset_leads_back_to_where_it_was_taken(motions) -> None:
    reference, moved = particles(1, 0.5, 0), particles(40, 0.5, 1)
    found = motions.compose(reference, motions.difference(moved, reference))
    torch.testing.assert_close(found, moved, atol=1e-4, rtol=0)
    still = motions.difference(reference, reference)
    torch.testing.assert_close(still, torch.zeros_like(still), atol=1e-5, rtol=0)


@both
def test_turning_leaves_the_middle_of_the_hand_where_it_is(motions) -> None:
    reference, tangent = particles(20, 0.5, 2), torch.zeros(20, 10)
    tangent[:, 3:6] = particles(20, 0.5, 3)[:, 3:6]
    found = motions.compose(reference, tangent)

    def middle(rows: Tensor) -> Tensor:
        turn = roma.rotvec_to_rotmat(rows[:, 3:6])
        return rows[:, :3] + turn @ torch.tensor(rigid.PIVOT_M)

    torch.testing.assert_close(middle(found), middle(reference), atol=1e-5, rtol=0)


def compared(motions: rigid.Motions, device: str = "cpu") -> None:
    """Raises AssertionError where motions on a device are not the reference's."""

    def check(found: Tensor, expected: Tensor) -> None:
        assert found.dtype == torch.float32 and found.device.type == device
        found = found.cpu()
        assert (found[:, 3:6].norm(dim=1) < math.pi + 1e-5).all()
        # Rotation vectors of length pi have two signs: compare what they do.
        rotations = (roma.rotvec_to_rotmat(rows[:, 3:6].double()) for rows in (found, expected))
        torch.testing.assert_close(*rotations, atol=5e-6, rtol=0)
        for part in (slice(0, 3), slice(6, None)):
            torch.testing.assert_close(found[:, part], expected[:, part], atol=5e-6, rtol=1e-5)

    for size in (0.0, 1e-8, 1e-4, 0.1, 1.0, 3.0):
        for many in ((70, 70), (1, 70), (70, 1)) if size == 0.1 else ((70, 70),):
            moved, tangent = particles(many[0], size, 4), particles(many[1], max(size, 0.1), 5)
            there = moved.to(device), tangent.to(device)
            check(motions.compose(*there), rigid.compose(moved, tangent))
            found = motions.difference(there[0], there[1][:1])
            check(found, rigid.difference(moved, tangent[:1]))


def test_compiled_motions_agree_with_the_reference() -> None:
    compared(rigid_numba.MOTIONS)


def test_triton_moves_particles_as_torch_does_as_far_as_its_interpreter_goes() -> None:
    pytest.importorskip("triton", reason="triton is not installed")
    code = "from compute.test_rigid import *; from toftrack.compute import rigid_triton\n"
    code += "compared(rigid_triton.MOTIONS)"
    done = python("-c", code, folder=ROOT / "tests", TRITON_INTERPRET="1")
    assert done.returncode == 0, done.stderr


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_cuda_moves_particles_as_torch_does() -> None:
    from toftrack.compute import rigid_triton

    compared(rigid_triton.MOTIONS, "cuda")


def test_no_particles_and_those_that_are_no_numbers() -> None:
    compiled = rigid_numba.MOTIONS
    reference = particles(1, 0.5, 6)
    assert compiled.difference(reference[:0], reference).shape == (0, 10)
    rows = particles(3, 0.5, 7)
    expected = compiled.difference(rows, reference)
    rows[1] = math.nan
    assert compiled.mean(rows, torch.full((3,), 1 / 3)).isnan().all()
    found = compiled.difference(rows, reference)
    assert found[1].isnan().all()
    assert torch.equal(found[::2], expected[::2])


def states(seed: int) -> Tensor:
    """(30, 27) float64: any pose, also beyond the joint limits, at and behind the camera."""
    g = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(ANGLE_LIMITS, dtype=torch.float64).T
    angles = 1.5 * (low + (high - low) * torch.rand(30, 21, generator=g, dtype=torch.float64))
    rows = torch.cat((2 * torch.randn(30, 6, generator=g, dtype=torch.float64), angles), 1)
    rows[0] = 0.0
    return rows


def compiled_hand(rows: Tensor, shape: HandShape) -> tuple[np.ndarray, np.ndarray]:
    """Joints (N, 21, 3) and frames (N, 16, 3, 3)."""
    hand = (part.numpy() for part in (shape.base_frames, shape.base_m, shape.bone_lengths_m))
    joints, frames = np.empty((len(rows), 21, 3)), np.empty((len(rows), 16, 3, 3))
    mirror = -1.0 if shape.side == "left" else 1.0
    rigid_numba.joints_of(rows.numpy(), *hand, mirror, joints, frames)
    return joints, frames


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_compiled_hand_is_that_of_the_reference(side: str) -> None:
    shape, rows = default_hand_shape(side=side).to(torch.float64), states(9)
    expected = forward_kinematics(rows, shape)
    joints, frames = compiled_hand(rows, shape)
    np.testing.assert_allclose(joints, expected.joints_m.numpy(), atol=1e-7)  # metres
    np.testing.assert_allclose(frames, expected.frames.numpy(), atol=1e-7)


def test_a_hand_that_is_no_number_is_none() -> None:
    shape, rows = default_hand_shape().to(torch.float64), states(10)[:3]
    rows[1, 3], rows[2, 0] = math.nan, math.inf
    joints, _ = compiled_hand(rows, shape)
    assert np.isfinite(joints[0]).all()
    assert not np.isfinite(joints[1:]).all((1, 2)).any()


@pytest.mark.parametrize("spread", [0.0, 0.1, 3.0])
def test_the_compiled_mean_is_that_of_the_reference(spread: float) -> None:
    draw = torch.Generator().manual_seed(3)
    rotvec = torch.tensor([2.0, -1.0, 0.5]) + spread * torch.randn(150, 3, generator=draw)
    weights = torch.rand(150, generator=draw, dtype=torch.float64)
    weights /= weights.sum()
    particles = torch.cat((rotvec.roll(1, 1), rotvec, rotvec), 1)
    found, expected = (module.mean(particles, weights)[0] for module in (rigid_numba, rigid))
    off = roma.rotvec_geodesic_distance(found[3:6].double(), expected[3:6].double())
    assert float(off) < 1e-5  # rad
    torch.testing.assert_close(found[[0, 1, 2, 6, 7, 8]], expected[[0, 1, 2, 6, 7, 8]])


@both
def test_the_mean_rotation_is_nearest_to_all(motions) -> None:
    rows = torch.zeros(3, 10)
    rows[:, 5] = torch.tensor([0.2, -0.2, 0.6])
    weights = torch.tensor([0.5, 0.5, 0.0], dtype=torch.float64)
    torch.testing.assert_close(motions.mean(rows, weights), torch.zeros(1, 10), atol=1e-6, rtol=0)
    # Across half a turn, where the vectors themselves point the other way.
    rows[:, 5] = torch.tensor([math.pi - 0.1, -math.pi + 0.1, 0.6])
    assert float(motions.mean(rows, weights).norm()) == pytest.approx(math.pi, abs=1e-5)


@both
def test_the_mean_rotation_commutes_with_a_turn_of_all(motions) -> None:
    rows, weights = particles(50, 0.3, 10), torch.rand(50, dtype=torch.float64)
    weights /= weights.sum()
    turned, turn = rows.clone(), torch.tensor([[0.7, -1.2, 0.4]])
    turned[:, 3:6] = roma.rotvec_composition((turn.expand(50, 3), rows[:, 3:6]))
    mean, after = (motions.mean(given, weights)[:, 3:6] for given in (rows, turned))
    torch.testing.assert_close(after, roma.rotvec_composition((turn, mean)), atol=1e-4, rtol=0)


@both
def test_a_coordinate_without_width_stays_where_it_is(motions) -> None:
    # As those that all training poses of a space share, whose least and largest are the same.
    lower, upper = torch.tensor([0.0, -1.0, 0.3]), torch.tensor([0.0, 1.0, 0.3])
    weights, positions = torch.full((50,), 1 / 50, dtype=torch.float64), torch.arange(50.0) / 50
    given = particles(50, 0.5, 8)[:, :9], weights, positions.double(), particles(50, 0.5, 9)[:, :9]
    for mode in rigid.BOUNDS:
        found = motions.redraw(*given, lower, upper, mode)
        assert found.isfinite().all()
        torch.testing.assert_close(found[:, [6, 8]], lower[[0, 2]].expand(50, 2))
