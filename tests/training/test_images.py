"""Training images: what is said of them is what they show."""

import math

import numpy as np
import pytest
import torch
from helpers.detection import channels, small_bank

from toftrack.detector.crops import CROP, CROP_CHANNELS, CROP_M
from toftrack.detector.network import PARTS, SEGMENTS
from toftrack.hand.skeleton import ANGLE_LIMITS
from toftrack.training.dice import Dice
from toftrack.training.hands import HAND, posed_hands
from toftrack.training.images import (
    WIDE_SIZE,
    Crops,
    WideImages,
    crop_images,
    other_hands,
    poorly_read,
    wide_images,
)
from toftrack.training.pictures import Lens, read_pictures

N = 48


@pytest.fixture(scope="module")
def crops() -> Crops:
    return crop_images(N, small_bank(), torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def images() -> WideImages:
    return wide_images(N, small_bank(), torch.Generator().manual_seed(0))


def test_crops_are_complete(crops: Crops) -> None:
    assert crops.image.shape == (N, CROP_CHANNELS, CROP, CROP)
    assert crops.image.abs().max() <= 1 and crops.image[:, 1:4].min() >= 0
    read = crops.image[:, 2] == 0
    assert torch.allclose(crops.image[:, 4:].mean(1)[read], crops.image[:, 0][read], atol=1e-5)
    for name, value in crops._asdict().items():
        assert len(value) == N and value.isfinite().all(), name
    low, high = torch.tensor(ANGLE_LIMITS).unbind(1)
    assert (crops.angles >= low).all() and (crops.angles <= high).all()
    assert crops.parts.min() >= -1 and crops.parts.max() < SEGMENTS
    assert crops.parts.shape == (N, PARTS, PARTS)
    assert 0.6 < crops.present.float().mean() < 1
    assert 0.4 < crops.right.float().mean() < 0.95


def test_joints_lie_on_what_the_crop_shows() -> None:
    """Where a crop's part is the hand, the depth is about that of its joints."""
    crops = crop_images(256, small_bank(), torch.Generator().manual_seed(0))
    hand = crops.parts == 1
    big = torch.nn.functional.avg_pool2d(crops.image[:, :1], CROP // PARTS)[:, 0]
    use = crops.present & (hand.sum((1, 2)) > 60)
    seen = torch.stack([(big[i][hand[i]].median()) for i in use.nonzero()[:, 0]]) * (CROP_M / 2)
    middle = crops.joints_m[use][:, :, 2].mean(1)
    assert (seen - middle).abs().median() < 0.025
    # And each is in the crop where its joints are, seen from the crop's centre.
    rows = hand.float() * torch.linspace(-0.5, 0.5, PARTS)[:, None] * CROP_M
    seen_y = rows.sum((1, 2)) / hand.sum((1, 2)).clamp(min=1)
    assert (seen_y[use] - crops.joints_m[use][:, :, 1].mean(1)).abs().median() < 0.03


def test_whole_images_are_complete(images: WideImages) -> None:
    assert images.image.shape == (N, 2, *WIDE_SIZE)
    assert images.image.min() >= 0 and images.image.max() <= 1
    for name, value in images._asdict().items():
        assert value.isfinite().all(), name
    assert (images.seen >= 0).all() and images.seen.max() < 3
    assert 0.5 < (images.seen[:, 0] > 0.15).float().mean() < 1, "some without a raised hand"


def test_what_is_far_is_read_in_part_and_nothing_else_changes() -> None:
    lens = Lens(*(torch.full((64,), value) for value in (100.0, 48.0, 40.0, 90.0, 70.0)))
    taken = torch.full((64, *WIDE_SIZE), 0.3)
    taken[:, :, 60:] = 2.0
    taken[:, 50:, :] = 0.0
    seen = poorly_read(taken, lens, Dice(torch.Generator().manual_seed(0)))
    near, far, nothing = taken == 0.3, taken == 2.0, taken == 0.0
    assert torch.equal(seen[near], taken[near])
    read = (seen == 2.0).flatten(1).sum(1) / far.flatten(1).sum(1)
    assert (read == 1).any() and (read < 0.1).any(), "of some cameras"
    stray = ((seen > 0) & nothing).flatten(1).sum(1)
    assert (stray == 0).any() and (stray > 0).any()
    outside = torch.zeros(WIDE_SIZE, dtype=torch.bool)
    outside[70:], outside[:, 90:] = True, True
    assert not (seen[:, outside & (taken[0] == 0)] > 0).any()


def test_hands_are_seen_where_it_is_said(images: WideImages) -> None:
    """At a hand's cell, something is about as near as the hand."""
    good = 0
    use = (images.seen[:, 0] > 0.6).nonzero()[:, 0].tolist()
    for i in use:
        u, v = ((images.cell[i, 0] + 0.5) * 4 - 0.5).round().long().tolist()
        if not (0 <= u < WIDE_SIZE[1] and 0 <= v < WIDE_SIZE[0]):
            continue
        near = images.image[i, 0, max(0, v - 2) : v + 3, max(0, u - 2) : u + 3] * 1.6
        good += bool(((near - images.depth_m[i, 0]).abs() < 0.07).any())
    assert good > 0.8 * len(use)


def test_what_lies_outside_of_the_image_is_marked_and_has_no_parts(crops: Crops) -> None:
    outside = crops.image[:, 3]
    cut = outside.amax((1, 2)) == 1
    assert 0.1 < float(cut.float().mean()) < 0.45
    assert (crops.image[:, 2] >= outside - 1e-6).all(), "nothing is read there"
    coarse = torch.nn.functional.avg_pool2d(outside[:, None], CROP // PARTS)[:, 0]
    assert (crops.parts[coarse == 1] == -1).all() and (crops.parts[coarse == 0] >= 0).all()
    # The truth is that of the whole hand: some joints lie where nothing is seen.
    joints = crops.joints_m[cut & crops.present]
    assert (joints.norm(dim=-1).amax(1) > 0.03).all()


def test_crops_are_read_as_the_reference_reads_them() -> None:
    generator = np.random.default_rng(0)
    n, side = 5, 2 * CROP
    depth = generator.uniform(0.3, 0.7, (n, side, side)).astype(np.float32)
    depth[generator.random(depth.shape) < 0.2] = 0
    labels = generator.integers(0, 5, depth.shape).astype(np.int8)
    distance = generator.uniform(0.4, 0.6, n).astype(np.float32)
    border = np.tile(np.array([1.0, 0.0, 9.0], np.float32), (n, 2, 1))
    border[2:, 0] = (0.0, 1.0, 0.1)
    border[3:, 1] = (-1.0, 0.0, 0.25)
    sides = torch.full((n, 2), side, dtype=torch.int32)
    lie = sides, torch.from_numpy(distance), torch.zeros(n), torch.from_numpy(border)
    image, parts = (one.numpy() for one in read_pictures(depth, labels, *lie))
    steps = (np.arange(side) + 0.5) / side - 0.5
    inside = np.ones(depth.shape, bool)
    inside[2:] &= (steps < 0.1)[:, None]
    inside[3:] &= steps > -0.25
    expected = channels(np.where(inside, depth, 0), inside, distance)
    np.testing.assert_allclose(image, expected, atol=1e-5)
    step = side // PARTS
    seen = labels[:, step // 2 :: step, step // 2 :: step]
    known = inside[:, step // 2 :: step, step // 2 :: step]
    assert np.array_equal(parts[known], seen[known]) and (parts[~known] == -1).all()


def test_a_quarter_turn_of_a_crop_is_one_of_what_is_read_and_not_of_where_the_image_ends() -> None:
    generator = np.random.default_rng(0)
    side = 2 * CROP
    depth = generator.uniform(0.3, 0.7, (1, side, side)).astype(np.float32)
    labels = generator.integers(0, 5, depth.shape).astype(np.int8)
    border = torch.tensor([[[1.0, 0.0, 0.2], [1.0, 0.0, 9.0]]])
    sides, distance = torch.full((1, 2), side, dtype=torch.int32), torch.tensor([0.5])
    held, turned = (
        read_pictures(depth, labels, sides, distance, torch.tensor([angle]), border)[0].numpy()
        for angle in (0.0, math.pi / 2)
    )
    # What was to the right is up.
    np.testing.assert_allclose(turned[0, :4], np.rot90(held[0, :4], 1, (1, 2)), atol=1e-5)
    assert held[0, 3, :, -5:].min() == 1 and turned[0, 3, :5].min() == 1


def test_many_second_hands_touch_the_first_and_mirror_it_and_the_others_are_apart() -> None:
    n, own = 400, Dice(torch.Generator().manual_seed(0))
    left = torch.arange(n) < 40
    hands = posed_hands(small_bank(), torch.tensor([[0.0, 0.0, 0.5]]).expand(n, 3), left, own, HAND)
    may = torch.arange(n) % 2 == 0
    second = other_hands(hands, small_bank(), own, touching=may)
    apart = (second.pivot_m - hands.pivot_m)[:, :2].norm(dim=1)
    beside = (apart < 0.14) & (apart >= 0.05)
    alike = (second.angles - hands.angles).abs().mean(1) < 0.12
    twins = alike & (second.left != hands.left)
    assert 0.3 < float(beside[may].float().mean()) < 0.7
    assert 0.15 < float(twins[may].float().mean()) < 0.35
    assert float(twins[~may].float().mean()) < 0.03, "only by chance"
    twins &= may & beside
    assert (second.parts[twins][..., 0] < 0).all(), "a mirror image holds nothing"
    assert 0.3 < float((second.parts[~may][..., 0] >= 0).any(1).float().mean()) < 0.6


@pytest.mark.parametrize("make", [crop_images, wide_images])
def test_a_seed_gives_the_same_images(make) -> None:
    one, two, other = (
        make(4, small_bank(), torch.Generator().manual_seed(seed)).image for seed in (1, 1, 2)
    )
    assert torch.equal(one, two) and not torch.equal(one, other)
