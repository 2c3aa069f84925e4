"""Hands to train on: sizes of people, and one kinematics for all."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.detection import small_bank

from toftrack.detector.shapes import shape_bank
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, HandShape, default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import HandSurface, hand_surface

pytestmark = pytest.mark.usefixtures("one_thread")


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
    assert len(surface) == len(hand_surface(default_hand_shape()))
    for i, row in enumerate(rows.tolist()):
        one = HandShape(*(getattr(bank.shape, n)[row] for n in NAMES))
        flesh = HandSurface(
            bank.surface.frame_index, bank.surface.centres_m[row], bank.surface.axes_m[row]
        )
        alone = forward_kinematics(state[i : i + 1], one)
        assert torch.allclose(alone.joints_m[0], pose.joints_m[i], atol=1e-6)
        posed = flesh.pose(alone)
        assert torch.allclose(posed.centres_m[0], ellipsoids.centres_m[i], atol=1e-6)
        assert torch.allclose(posed.axes_m[0], ellipsoids.axes_m[i], atol=1e-6)


NAMES = ("base_m", "base_frames", "bone_lengths_m")


def test_flesh_lies_about_the_bones_of_its_own_hand() -> None:
    """Within some percent of the ellipsoids that this skeleton would be given."""
    bank = small_bank()
    for row in range(4):
        shape = HandShape(*(getattr(bank.shape, n)[row] for n in NAMES))
        plain = hand_surface(shape)
        off = bank.surface.centres_m[row] - plain.centres_m
        assert off.norm(dim=1).max() < 0.008
        grown = bank.surface.axes_m[row].norm(dim=1) / plain.axes_m.norm(dim=1)
        # Thickness varies by 10 %, within 0.75 and 1.35, and each axis by 6 %.
        assert 0.5 < float(grown.min()) and float(grown.max()) < 1.8
        assert float(grown.log().std()) > math.log(1.02)


def test_a_seed_gives_the_same_hands() -> None:
    one, two = (shape_bank(3, torch.Generator().manual_seed(7)) for _ in range(2))
    assert torch.equal(one.shape.base_m, two.shape.base_m)
    assert torch.equal(one.surface.axes_m, two.surface.axes_m)
