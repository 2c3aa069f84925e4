"""The components of the hand's shape: each does what its name says, and nothing else."""

import pytest
import torch

from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.shape_space import COMPONENTS, POPULATION_SIGMA, shape_derivatives, shaped
from toftrack.hand.surface import hand_surface


def with_components(**values: float) -> HandShape:
    components = torch.tensor([values.get(name, 0.0) for name in COMPONENTS])
    return shaped(default_hand_shape(), components)


def fingers(shape: HandShape) -> torch.Tensor:
    return shape.bone_lengths_m.sum(1)


def breadth(shape: HandShape) -> torch.Tensor:
    return (shape.base_m[1] - shape.base_m[4])[0]


def test_without_components_the_hand_is_the_one_it_starts_from() -> None:
    first, same = default_hand_shape(), with_components()
    torch.testing.assert_close(same.base_m, first.base_m)
    torch.testing.assert_close(same.bone_lengths_m, first.bone_lengths_m)
    assert same.thickness == first.thickness


def test_only_the_length_changes_the_hands_length() -> None:
    first = default_hand_shape()
    assert with_components(length=0.1).hand_length_m == pytest.approx(0.19 * 1.10517, rel=1e-4)
    for name, sigma in zip(COMPONENTS[1:], POPULATION_SIGMA[1:], strict=True):
        other = with_components(**{name: 2 * sigma})
        assert other.hand_length_m == pytest.approx(first.hand_length_m, rel=1e-5), name


def test_long_fingers_come_with_a_short_palm() -> None:
    first, other = default_hand_shape(), with_components(fingers=0.1)
    assert (fingers(other) > 1.03 * fingers(first)).all()
    palm = other.base_m[2].norm() / first.base_m[2].norm()
    ratio = fingers(other)[2] / fingers(first)[2] / palm
    assert float(ratio.log()) == pytest.approx(0.1, abs=0.002)


def test_a_broad_hand_is_as_much_thicker_and_a_thick_one_is_no_broader() -> None:
    first = default_hand_shape()
    broad, thick = with_components(breadth=0.1), with_components(thickness=0.1)
    assert float(breadth(broad) / breadth(first)) == pytest.approx(1.105, abs=0.01)
    assert broad.thickness == pytest.approx(thick.thickness)
    torch.testing.assert_close(thick.base_m, first.base_m)
    assert hand_surface(thick).axes_m.norm() > hand_surface(first).axes_m.norm()


def test_thumb_and_outer_fingers() -> None:
    first = default_hand_shape()
    thumb = fingers(with_components(thumb=0.1)) / fingers(first)
    assert float(thumb[0].log()) == pytest.approx(0.1, abs=1e-3)
    torch.testing.assert_close(thumb[1:], torch.ones(4))
    outer = (fingers(with_components(outer=0.1)) / fingers(first)).log()
    assert outer[1] > outer[2] > outer[3] > outer[4]
    assert float(outer[1] - outer[4]) == pytest.approx(0.2, abs=1e-3)


def test_derivatives_are_those_of_the_shape() -> None:
    at = torch.tensor([0.05, 0.03, -0.02, 0.04, 0.01, 0.02])
    base, bones = map(torch.from_numpy, shape_derivatives(default_hand_shape(), at))
    step = 0.004 * torch.tensor([1.0, -2.0, 1.5, 0.5, 1.0, -1.0])
    here, there = (shaped(default_hand_shape(), c) for c in (at, at + step))
    off = (there.base_m - here.base_m) - torch.einsum("k,kij->ij", step, base)
    assert off.abs().max() < 2e-5
    off = (there.bone_lengths_m - here.bone_lengths_m) - torch.einsum("k,kij->ij", step, bones)
    assert off.abs().max() < 2e-5
