"""Hands to train on: sizes of people, and one kinematics for all."""

import math

import pytest
import torch
from helpers.detection import dice, small_bank

from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import hand_surface
from toftrack.training.shapes import cupped, shape_bank


def test_hands_are_as_long_as_those_of_children_and_adults() -> None:
    bank = shape_bank(150, torch.Generator().manual_seed(1))
    lengths = DEFAULT_HAND_LENGTH_M * bank.log_size.exp()
    reported = bank.shape.base_m[:, 2].norm(dim=1) + bank.shape.bone_lengths_m[:, 2].sum(1)
    assert torch.allclose(lengths, reported, atol=1e-6)
    # 135 to 215 mm, and proportions that vary by some percent about it.
    assert 0.115 < float(lengths.min()) < 0.15 and 0.20 < float(lengths.max()) < 0.25
    assert (bank.shape.bone_lengths_m > 0.005).all()
    assert torch.linalg.det(bank.shape.base_frames) == pytest.approx(1, abs=1e-4)
    assert torch.linalg.det(bank.surface.axes_m).abs().min() > 0, "no ellipsoid is flat"


def test_a_row_is_a_hand_as_any_other() -> None:
    bank = small_bank()
    rows = torch.tensor([5, 0, 5, 11])
    state = 0.3 * torch.randn(4, 27, generator=torch.Generator().manual_seed(0))
    shape, surface = bank.rows(rows)
    pose = forward_kinematics(state, shape)
    ellipsoids = surface.pose(pose)
    assert torch.equal(surface.frame_index, hand_surface(default_hand_shape()).frame_index)
    for i, row in enumerate(rows.tolist()):
        one, flesh = bank.rows(torch.tensor(row))
        alone = forward_kinematics(state[i : i + 1], one)
        assert torch.allclose(alone.joints_m[0], pose.joints_m[i], atol=1e-6)
        posed = flesh.pose(alone)
        assert torch.allclose(posed.centres_m[0], ellipsoids.centres_m[i], atol=1e-6)
        assert torch.allclose(posed.axes_m[0], ellipsoids.axes_m[i], atol=1e-6)


def test_flesh_lies_about_the_bones_of_its_own_hand() -> None:
    """Within some percent of the ellipsoids that this skeleton would be given."""
    bank = small_bank()
    for row in range(4):
        shape, surface = bank.rows(torch.tensor(row))
        plain = hand_surface(shape)
        off = surface.centres_m - plain.centres_m
        assert off.norm(dim=1).max() < 0.008
        grown = surface.axes_m.norm(dim=1) / plain.axes_m.norm(dim=1)
        # Thickness varies by 10 %, within 0.75 and 1.35, and each axis by 6 %.
        assert 0.5 < float(grown.min()) and float(grown.max()) < 1.8
        assert float(grown.log().std()) > math.log(1.02)


def _hollow(curled: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Of hands whose fingers are bent by a share of a fist's: by how much cupping moves the joints
    (N, 21, 3), and how far thenar and hypothenar stand out before the palm's middle (N, 2), m.
    """
    n = 200
    rows = torch.arange(n) % 12
    bank = small_bank()
    state = torch.zeros(n, 27)
    for joint in (1, 2):
        state[:, 11 + joint :: 4] = curled * math.radians(95.0)
    before, _ = bank.rows(rows)
    shape, surface = cupped(*bank.rows(rows), state[:, 6:], bank.log_size[rows], dice(3))
    pose = forward_kinematics(state, shape)
    moved = pose.joints_m - forward_kinematics(state, before).joints_m
    pads = surface.pose(pose)
    nearest = (pads.centres_m - pads.axes_m.norm(dim=3))[:, 20:29, 2]  # towards the palm, -z
    middle = nearest[:, 1:3].mean(1)
    return moved, middle[:, None] - nearest[:, 5:7]


def test_a_hand_that_closes_cups_and_a_flat_one_hardly_does() -> None:
    flat, fist = _hollow(0.0), _hollow(1.0)
    knuckles = [moved[:, 17, 2] for moved, _ in (flat, fist)]
    assert float(knuckles[0].abs().mean()) < 0.003
    # Towards the palm, as the fifth metacarpal gives way: 6 mm on average.
    assert float(knuckles[1].mean()) < -0.006
    for moved, _ in (flat, fist):
        assert moved[:, :13].abs().max() < 1e-5, "thumb, index and middle finger stay"
        assert (moved[:, 13:].norm(dim=2) < 0.05).all()
    relief = [stands_out.mean(0) for _, stands_out in (flat, fist)]
    assert (relief[1] > relief[0] + 0.008).all()
