"""The points and the silhouette that the refinement sees of a frame."""

from dataclasses import replace

import numba
import numpy as np
import pytest
import torch
from helpers.settings import nearest_surface
from helpers.tracking import sample

from toftrack.refinement import seen_points as seen_points_of
from toftrack.refinement.seen_points import seen_points
from toftrack.render.segmentation import Observation


def observed(frame: int) -> Observation:
    scene = sample().cut(frame)
    return nearest_surface()(scene.depth_m[0], scene.k)


@pytest.mark.parametrize("share", [0.0005, 0.01, 0.6])
def test_the_nearest_pixel_that_is_not_background_is_found(share: float) -> None:
    draw = np.random.default_rng(1)
    solid = draw.random((90, 110)) < share
    solid[7, 100] = True
    depth, k = np.zeros(solid.shape, np.float32), np.eye(3, dtype=np.float32)
    _, beside = seen_points_of.smooth_points(depth, ~solid, solid, (0, 0), k)
    nearest_solid = numba.njit(seen_points_of.nearest_solid.py_func)
    places = np.argwhere(solid)
    for pixel in np.stack((draw.integers(90, size=300), draw.integers(110, size=300)), 1):
        found = nearest_solid(beside, *pixel)
        assert solid[found]
        away = np.linalg.norm(places - pixel, axis=1).min()
        assert np.linalg.norm(pixel - found) == pytest.approx(away)


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (1, 7), (60, 80)])
def test_points_are_those_of_plain_loops(shape: tuple[int, int]) -> None:
    draw = np.random.default_rng(0)
    depth = 0.5 + 0.04 * draw.random(shape, np.float32)
    depth[draw.random(shape) < 0.1] = 0
    hand = (draw.random(shape) < 0.7) & (depth > 0)
    k = np.array([[200.0, 0, 44], [0, 210, 33], [0, 0, 1]], np.float32)
    expected = []
    for v, u in zip(*hand.nonzero(), strict=True):
        around = depth[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
        if np.ptp(np.where(around > 0, around, 10.0)) < 0.03:
            z = depth[v, u]
            expected.append(((u + 4 - 44) / 200 * z, (v + 3 - 33) / 210 * z, z))
    found, _ = seen_points_of.smooth_points(depth, hand, hand, (3, 4), k)
    np.testing.assert_allclose(found, np.reshape(expected, (-1, 3)), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (40, 30)])
def test_an_image_of_nothing_has_no_points_and_no_silhouette(size: tuple[int, int]) -> None:
    nothing = torch.zeros(size, dtype=torch.bool)
    seen = seen_points(Observation(torch.zeros(size), nothing, nothing, torch.eye(3), np.inf))
    assert len(seen.points_m) == 0 and seen.beside.numel() == 0


def test_an_occluder_is_part_of_the_silhouette_and_has_no_points() -> None:
    observation = observed(0)
    covered = replace(
        observation, hand=torch.zeros_like(observation.hand), occluder=observation.hand.clone()
    )
    seen, plain = seen_points(covered), seen_points(observation)
    assert len(seen.points_m) == 0
    assert torch.equal(seen.beside, plain.beside)


def test_a_thing_in_the_hand_is_no_background() -> None:
    seen = observed(0)
    held = replace(seen, hand=torch.zeros_like(seen.hand), thing=seen.hand.clone())
    assert torch.equal(seen_points(held).beside, seen_points(seen).beside)
