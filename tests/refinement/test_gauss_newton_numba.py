"""Refinement: it finds the hand, and the compiled version does what the reference does."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from toftrack.compute.threads import small_operations, threads
from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import Ellipsoids, hand_surface
from toftrack.refinement.gauss_newton import (
    Refinement,
    Refiner,
    Surroundings,
    TorchRefiner,
    make_refiner,
    surroundings,
)
from toftrack.refinement.gauss_newton_numba import CompiledRefiner
from toftrack.render.closed_form import render_range_images
from toftrack.render.segmentation import Observation
from toftrack.tracking import particle_filter as sir

K = torch.tensor([[220.0, 0.0, 88.0], [0.0, 220.0, 72.0], [0.0, 0.0, 1.0]])


def seen_hand(shape: HandShape, generator: torch.Generator) -> tuple[Tensor, Surroundings, Tensor]:
    """A random true state, what the camera sees of it, and a state near it to start from."""
    state = torch.zeros(1, 27)
    state[0, :3] = torch.tensor([0.0, 0.05, 0.45])
    state[0, 3:] = 0.2 * torch.randn(24, generator=generator)
    both = hand_surface(shape).pose(forward_kinematics(state, shape))
    hand = Ellipsoids(both.centres_m[:, :-1], both.axes_m[:, :-1])
    depth = render_range_images(hand, K, 144, 176)[0]
    observation = Observation(depth, depth > 0, torch.zeros_like(depth, dtype=torch.bool), K, 0.4)
    seen = surroundings(observation, state[0, :3] + torch.tensor(sir.PIVOT_M), 500)
    spread = torch.tensor([0.005] * 3 + [0.08] * 24)
    return state, seen, state + spread * torch.randn(1, 27, generator=generator)


def error_m(refiner: Refiner, state: Tensor, truth: Tensor) -> float:
    return float((refiner.joints(state) - refiner.joints(truth)).norm(dim=1).mean())


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("iterations", [1, 5])
def test_the_compiled_version_agrees_with_the_reference(side, iterations):
    shape = default_hand_shape(side=side)
    surface, settings = hand_surface(shape), Refinement(iterations=iterations)
    reference, compiled = TorchRefiner(shape, surface), CompiledRefiner(shape, surface)
    generator = torch.Generator().manual_seed(1)
    for _ in range(2):
        _, seen, start = seen_hand(shape, generator)
        expected = reference(start, start[:, 6:], seen, settings)
        found = compiled(start, start[:, 6:], seen, settings)
        assert found.dtype == torch.float32 and found.shape == (1, 27)
        assert float((expected - start).abs().max()) > 0.01
        torch.testing.assert_close(found, expected, atol=1e-3, rtol=0)
        torch.testing.assert_close(
            compiled.joints(found), reference.joints(found), atol=1e-6, rtol=0
        )


def test_refinement_draws_the_hand_onto_the_points():
    shape = default_hand_shape()
    refiner = make_refiner(shape, hand_surface(shape), "numba")
    assert isinstance(refiner, CompiledRefiner)
    generator = torch.Generator().manual_seed(2)
    before, after = 0.0, 0.0
    for _ in range(8):
        truth, seen, start = seen_hand(shape, generator)
        before += error_m(refiner, start, truth)
        after += error_m(refiner, refiner(start, start[:, 6:], seen, Refinement()), truth)
    assert after < 0.6 * before


def test_a_state_that_is_no_number_stays_one_and_harms_nothing():
    shape = default_hand_shape()
    refiner = make_refiner(shape, hand_surface(shape), "numba")
    _, seen, start = seen_hand(shape, torch.Generator().manual_seed(3))
    broken = torch.full_like(start, torch.nan)
    assert refiner(broken, broken[:, 6:], seen, Refinement()).isnan().any()


def test_other_back_ends_refine_in_torch():
    shape = default_hand_shape()
    assert isinstance(make_refiner(shape, hand_surface(shape), "torch"), TorchRefiner)


@pytest.mark.parametrize("size", [1e-4, 0.1, 1.0, 3.0])
def test_compiled_tangents_agree_with_eager_ones(monkeypatch, size):
    generator = torch.Generator().manual_seed(4)
    particles = size * torch.randn(50, 10, generator=generator)
    tangent = torch.randn(50, 10, generator=generator) * 0.1
    found = sir.compose(particles, tangent), sir.difference(particles, particles[:1])
    monkeypatch.setattr(sir, "_compiled", lambda _: None)
    expected = sir.compose(particles, tangent), sir.difference(particles, particles[:1])
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a[:, :3], b[:, :3], atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(a[:, 6:], b[:, 6:])
        # Rotation vectors of length pi have two signs: compare what they do.
        turn = sir.rotated_pivot(a[:, 3:6]), sir.rotated_pivot(b[:, 3:6])
        torch.testing.assert_close(*turn, atol=1e-5, rtol=1e-5)


def test_small_operations_leave_the_threads_to_others():
    before = torch.get_num_threads()
    allowed = threads()
    with small_operations():
        assert torch.get_num_threads() == 1
        assert threads() == allowed
    assert torch.get_num_threads() == before
