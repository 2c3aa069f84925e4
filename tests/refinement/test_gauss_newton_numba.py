"""The compiled refinement does what the reference does, and what it is for."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch
from helpers.configured import nearest_surface, refinement
from helpers.tracking import sample
from reference.refinement import TorchRefiner
from torch import Tensor

from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import Ellipsoids, hand_surface
from toftrack.refinement.gauss_newton import Keypoints
from toftrack.refinement.gauss_newton_numba import Refiner
from toftrack.refinement.seen_points import SeenPoints, seen_points
from toftrack.render.closed_form import render_range_images
from toftrack.render.segmentation import Observation

pytestmark = pytest.mark.usefixtures("one_thread")

K = torch.tensor([[220.0, 0.0, 88.0], [0.0, 220.0, 72.0], [0.0, 0.0, 1.0]])
SETTINGS = refinement()
SPREAD = torch.tensor([0.005] * 3 + [0.08] * 24)


def seen_hand(
    shape: HandShape, generator: torch.Generator, n: int = 1
) -> tuple[Tensor, SeenPoints, Tensor]:
    """A random true state, what the camera sees of it, and n states near it to start from."""
    state = torch.zeros(1, 27)
    state[0, :3] = torch.tensor([0.0, 0.05, 0.45])
    state[0, 3:] = 0.2 * torch.randn(24, generator=generator)
    both = hand_surface(shape).pose(forward_kinematics(state, shape))
    hand = Ellipsoids(both.centres_m[:, :-1], both.axes_m[:, :-1])
    depth = render_range_images(hand, K, 144, 176)[0]
    observation = Observation(depth, depth > 0, torch.zeros_like(depth, dtype=torch.bool), K, 0.4)
    starts = state + SPREAD * torch.randn(n, 27, generator=generator)
    return state, seen_points(observation), starts


def error_m(refiner: TorchRefiner | Refiner, states: Tensor, truth: Tensor) -> Tensor:
    return (refiner.joints(states) - refiner.joints(truth)).norm(dim=-1).mean(-1)


def check_joints(shape: HandShape, found: Tensor, expected: Tensor, atol_m: float = 0.002) -> None:
    """A point that is as near to two bones goes to either, and the steps part by a little."""
    joints = [forward_kinematics(states, shape).joints_m for states in (found, expected)]
    torch.testing.assert_close(*joints, atol=atol_m, rtol=0)


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("iterations", [1, 5])
def test_it_agrees_with_the_reference(side: str, iterations: int) -> None:
    shape, settings = default_hand_shape(side=side), refinement(iterations=iterations)
    reference, compiled = TorchRefiner(shape), Refiner(shape)
    generator = torch.Generator().manual_seed(1)
    for _ in range(2):
        _, seen, starts = seen_hand(shape, generator, n=5)
        expected = reference(starts, starts[:, 6:], seen, settings)
        found = compiled(starts, starts[:, 6:], seen, settings)
        assert found.dtype == torch.float32 and found.shape == (5, 27)
        assert ((expected - starts).abs().amax(1) > 0.01).all()
        check_joints(shape, found, expected)
        torch.testing.assert_close(
            compiled.joints(found), reference.joints(found), atol=1e-5, rtol=0
        )


@pytest.mark.parametrize("side", ["right", "left"])
def test_it_agrees_with_the_reference_on_a_recording(side: str) -> None:
    shape = default_hand_shape(side=side)
    reference, compiled = TorchRefiner(shape), Refiner(shape)
    for frame in (0, 36, 72):
        scene = sample().cut(frame)
        if side == "left":
            scene = scene.mirrored()
        seen = seen_points(nearest_surface()(scene.depth_m[0], scene.k))
        starts = torch.zeros(3, 27)
        starts[:, :3] = torch.from_numpy(scene.joints_m[0, 0])
        starts += SPREAD * torch.randn(3, 27, generator=torch.Generator().manual_seed(frame))
        found = [r(starts, starts[:, 6:], seen, SETTINGS) for r in (reference, compiled)]
        check_joints(shape, *found, atol_m=0.003)


@pytest.mark.parametrize("own", [False, True])
def test_it_agrees_with_the_reference_about_landmarks(own: bool) -> None:
    shape = default_hand_shape()
    reference, compiled = TorchRefiner(shape), Refiner(shape)
    generator = torch.Generator().manual_seed(5)
    truth, seen, starts = seen_hand(shape, generator, n=3)
    points = reference.joints(truth)[0] + 0.004 * torch.randn(21, 3, generator=generator)
    sigma = 0.002 + 0.02 * torch.rand(21, generator=generator)
    sigma[4], sigma[8], points[12, 1] = math.inf, 0.0, math.nan
    if own:
        points, sigma = points + 0.01 * torch.arange(3)[:, None, None], sigma.repeat(3, 1)
    without = compiled(starts, starts[:, 6:], seen, SETTINGS)
    nothing = replace(seen, points_m=torch.zeros(0, 3))
    for what in (seen, nothing):
        marks = Keypoints(points, sigma)
        found = compiled(starts, starts[:, 6:], what, SETTINGS, marks)
        check_joints(shape, found, reference(starts, starts[:, 6:], what, SETTINGS, marks))
        assert (error_m(compiled, found, without) > 1e-4).all()


def test_it_draws_hands_onto_the_points() -> None:
    refiner = Refiner(default_hand_shape())
    generator = torch.Generator().manual_seed(2)
    before, after = 0.0, 0.0
    for _ in range(4):
        truth, seen, starts = seen_hand(default_hand_shape(), generator, n=4)
        found = refiner(starts, starts[:, 6:], seen, SETTINGS)
        before += float(error_m(refiner, starts, truth).mean())
        after += float(error_m(refiner, found, truth).mean())
    assert after < 0.6 * before


def test_hypotheses_do_not_know_of_each_other() -> None:
    """Together, alone, in threads and in calls at the same time: the same to the last bit."""
    refiner = Refiner(default_hand_shape())
    _, seen, starts = seen_hand(default_hand_shape(), torch.Generator().manual_seed(3), n=12)
    starts[1], starts[4, 3] = math.nan, math.inf
    starts[7, 0] += 1.0
    alone = [refiner(start, start[:, 6:], seen, SETTINGS) for start in starts.split(1)]
    torch.set_num_threads(4)
    with ThreadPoolExecutor(3) as pool:
        calls = [pool.submit(refiner, starts, starts[:, 6:], seen, SETTINGS) for _ in range(6)]
    for call in calls:
        assert torch.equal(call.result().nan_to_num(), torch.cat(alone).nan_to_num())
    assert alone[1].isnan().all() and not alone[4].isfinite().all()
    assert torch.equal(alone[7], starts[7:8]), "it sees nothing"


def test_nothing_seen_leaves_the_states_as_they_are() -> None:
    refiner = Refiner(default_hand_shape())
    _, seen, starts = seen_hand(default_hand_shape(), torch.Generator().manual_seed(4), n=3)
    nothing = replace(seen, points_m=torch.zeros(0, 3), nearest_px=torch.zeros(0, 0, 2))
    assert torch.equal(refiner(starts, 0 * starts[:, 6:], nothing, SETTINGS), starts)
    assert refiner(starts[:0], starts[:0, 6:], seen, SETTINGS).shape == (0, 27)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1)])
def test_images_of_a_pixel_s_width_do_no_harm(size: tuple[int, int]) -> None:
    depth = torch.full(size, 0.45)
    hand = torch.ones(size, dtype=torch.bool)
    k = torch.tensor([[220.0, 0.0, 0.0], [0.0, 220.0, 0.0], [0.0, 0.0, 1.0]])
    seen = seen_points(Observation(depth, hand, ~hand, k, 0.45))
    shape = default_hand_shape()
    start = torch.zeros(1, 27)
    start[0, 1:3] = torch.tensor([0.08, 0.46])
    found = [
        refiner(start, start[:, 6:], seen, SETTINGS)
        for refiner in (TorchRefiner(shape), Refiner(shape))
    ]
    check_joints(shape, *found)


@pytest.mark.parametrize("z", [-0.4, 0.0, 0.03])
def test_hands_at_and_behind_the_camera_agree_too(z: float) -> None:
    shape = default_hand_shape()
    _, seen, start = seen_hand(shape, torch.Generator().manual_seed(6))
    start[0, 2] = z
    moved = replace(seen, points_m=seen.points_m + torch.tensor([0.0, 0.0, z - 0.45]))
    found = [
        refiner(start, start[:, 6:], moved, refinement(iterations=1))
        for refiner in (TorchRefiner(shape), Refiner(shape))
    ]
    assert found[0].isfinite().all()
    check_joints(shape, *found)
