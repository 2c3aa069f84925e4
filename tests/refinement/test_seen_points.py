"""The points and the silhouette that the refinement sees of a frame."""

from __future__ import annotations

from dataclasses import replace

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


@pytest.mark.parametrize("frame", [0, 40, 80])
def test_the_points_are_those_of_the_hand_without_its_edges(frame: int) -> None:
    observation = observed(frame)
    seen = seen_points(observation)
    assert 100 < len(seen.points_m) < int(observation.hand.sum())
    pixel = (seen.points_m @ seen.k.T)[:, :2]
    u, v = (pixel / seen.points_m[:, 2:]).round().long().T
    assert observation.hand[v, u].all()
    torch.testing.assert_close(observation.depth_m[v, u], seen.points_m[:, 2])
    rows = (v[:, None] + torch.tensor([-1, 0, 1])).clamp(max=len(observation.depth_m) - 1)
    around = observation.depth_m[rows, u[:, None]]
    assert (around.amax(1) - around.amin(1) < 0.03).all()
    # On the silhouette the nearest pixel that is not background is the pixel itself.
    top, left = seen.corner
    assert torch.equal(seen.nearest_px[v - top, u - left], torch.stack((u, v), 1).float())


def test_the_nearest_pixel_of_the_background_is_on_the_silhouette() -> None:
    observation = observed(0)
    seen = seen_points(observation)
    hand = observation.hand.nonzero().flip(1).float()
    top, left = seen.corner
    g = np.random.default_rng(0)
    height, width = seen.nearest_px.shape[:2]
    for row, column in zip(g.integers(height, size=50), g.integers(width, size=50), strict=True):
        here = torch.tensor([float(column + left), float(row + top)])
        found = (seen.nearest_px[row, column] - here).norm()
        nearest = (hand - here).norm(dim=1).amin()
        # OpenCV's labels go by a distance that is within a few percent of the Euclidean one.
        assert nearest - 1e-4 <= found <= 1.05 * nearest + 0.5


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (1, 7), (60, 80)])
def test_points_and_nearest_pixels_are_those_of_plain_loops(shape: tuple[int, int]) -> None:
    draw = np.random.default_rng(0)
    depth = 0.5 + 0.02 * draw.random(shape, np.float32)
    depth[draw.random(shape) < 0.1] = 0
    hand = (draw.random(shape) < 0.7) & (depth > 0)
    k = np.array([[200.0, 0, 44], [0, 210, 33], [0, 0, 1]], np.float32)
    expected = []
    for v, u in zip(*hand.nonzero(), strict=True):
        around = depth[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
        if np.ptp(np.where(around > 0, around, 10.0)) < 0.03:
            z = depth[v, u]
            expected.append(((u + 4 - 44) / 200 * z, (v + 3 - 33) / 210 * z, z))
    found = seen_points_of.smooth_points(depth, hand, (3, 4), k)
    np.testing.assert_allclose(found, np.reshape(expected, (-1, 3)), rtol=1e-5, atol=1e-6)
    labels = np.zeros(shape, np.int32)
    labels[hand] = draw.permutation(np.count_nonzero(hand)) + 1
    labels[~hand] = draw.integers(0, np.count_nonzero(hand) + 1, np.count_nonzero(~hand))
    place = {labels[v, u]: (u + 4, v + 3) for v, u in zip(*hand.nonzero(), strict=True)}
    found = seen_points_of.nearest_of_labels(labels, hand, (3, 4))
    expected = [place.get(label, (0, 0)) for label in labels.ravel()]
    np.testing.assert_array_equal(found, np.reshape(expected, (*shape, 2)))


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (40, 30)])
def test_an_image_of_nothing_has_no_points_and_no_silhouette(size: tuple[int, int]) -> None:
    nothing = torch.zeros(size, dtype=torch.bool)
    seen = seen_points(Observation(torch.zeros(size), nothing, nothing, torch.eye(3), np.inf))
    assert len(seen.points_m) == 0 and seen.nearest_px.numel() == 0


def test_an_image_of_one_pixel_is_a_point() -> None:
    hand = torch.ones(1, 1, dtype=torch.bool)
    seen = seen_points(Observation(torch.full((1, 1), 0.5), hand, ~hand, torch.eye(3), 0.5))
    assert torch.equal(seen.points_m, torch.tensor([[0.0, 0.0, 0.5]]))
    assert torch.equal(seen.nearest_px, torch.zeros(1, 1, 2))


def test_an_occluder_is_part_of_the_silhouette_and_has_no_points() -> None:
    observation = observed(0)
    covered = replace(
        observation, hand=torch.zeros_like(observation.hand), occluder=observation.hand.clone()
    )
    seen, plain = seen_points(covered), seen_points(observation)
    assert len(seen.points_m) == 0
    assert torch.equal(seen.nearest_px, plain.nearest_px)
