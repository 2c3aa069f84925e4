"""Segmentation: the nearest surface, what lies behind it, and what hides it."""

import math

import cv2
import numpy as np
import pytest
from helpers.settings import nearest_surface
from helpers.tracking import sample

from toftrack.evaluation.trust import TIPS
from toftrack.render.segmentation import Expected, NearestSurface, reduce_image

HEIGHT, WIDTH, FOCAL = 60, 80, 100.0
K = np.array([[FOCAL, 0, 39.0], [0, FOCAL, 31.0], [0, 0, 1]])
HAND = (slice(10, 40), slice(20, 50))  # 30 x 30 pixels


def picture(hand_m: float = 0.5, wall_m: float = 1.0) -> np.ndarray:
    """A flat hand in front of a wall."""
    depth = np.full((HEIGHT, WIDTH), wall_m, np.float32)
    depth[HAND] = hand_m
    return depth


def hand_of(depth: np.ndarray, expected: Expected | None = None, **settings) -> np.ndarray:
    return nearest_surface(**settings)(depth, K, expected).hand.numpy()


def test_the_nearest_surface_and_what_is_up_to_20_cm_behind_it_is_the_hand() -> None:
    depth = picture()
    depth[40:50, 20:50] = 0.69  # its arm
    depth[50:55, 20:50] = 0.71  # too far behind
    hand = hand_of(depth)
    assert hand[HAND].all() and hand[40:50, 20:50].all()
    assert hand.sum() == 40 * 30
    assert nearest_surface()(depth, K).nearest_m == pytest.approx(0.5)


@pytest.mark.parametrize("seed", range(3))
def test_specks_and_flying_pixels_are_no_hand(seed: int) -> None:
    clean = picture()
    noisy = clean.copy()
    rng = np.random.default_rng(seed)
    rows, columns = np.nonzero(cv2.dilate((clean < 1).astype(np.uint8), np.ones((3, 3))) == 0)
    chosen = rng.choice(len(rows), 40, replace=False)
    noisy[rows[chosen], columns[chosen]] = rng.uniform(0.15, 0.45, 40)
    seen = nearest_surface()(noisy, K)
    assert seen.nearest_m == pytest.approx(0.5)
    assert not seen.hand.numpy()[rows[chosen], columns[chosen]].any()
    assert seen.hand.numpy()[HAND].all()
    # The paper takes the single nearest pixel, whatever it is.
    single = nearest_surface(min_area_m2=0)(noisy, K)
    assert single.nearest_m == pytest.approx(float(noisy.min()))


@pytest.mark.parametrize(
    "depth",
    [
        np.zeros((HEIGHT, WIDTH), np.float32),
        np.full((HEIGHT, WIDTH), 1.3, np.float32),
        np.full((HEIGHT, WIDTH), np.nan, np.float32),
        np.full((HEIGHT, WIDTH), np.inf, np.float32),
        np.full((HEIGHT, WIDTH), -0.5, np.float32),
    ],
    ids=["no reading", "too far", "nan", "infinity", "negative"],
)
@pytest.mark.parametrize("expected", [None, Expected(0.45, 0.55)])
def test_nothing_in_range_is_empty(depth: np.ndarray, expected: Expected | None) -> None:
    seen = nearest_surface()(depth, K, expected)
    assert seen.empty
    assert math.isinf(seen.nearest_m)
    assert not seen.hand.any() and not seen.occluder.any()


def test_no_reading_is_never_part_of_anything() -> None:
    depth = picture()
    for row, value in enumerate((0.0, np.nan, np.inf, -0.3)):
        depth[12 + row, 25:45] = value
    hand = hand_of(depth)
    assert not hand[12:16, 25:45].any()
    assert hand.sum() == 900 - 80


def with_occluder() -> np.ndarray:
    depth = picture()
    depth[20:30, 0:60] = 0.35  # a bar across the hand
    return depth


def test_what_comes_in_front_of_a_tracked_hand_hides_it() -> None:
    seen = nearest_surface()(with_occluder(), K, Expected(0.49, 0.55))
    hand, occluder = seen.hand.numpy(), seen.occluder.numpy()
    assert occluder[20:30, 0:60].all()
    assert seen.nearest_m == pytest.approx(0.5)
    assert hand[10:19, 20:50].all() and hand[31:40, 20:50].all()
    assert not (hand & occluder).any()
    # Its edge mixes both depths and is neither.
    assert occluder.sum() == 12 * 61


def test_without_a_tracked_hand_the_bar_in_front_is_the_nearest_surface() -> None:
    for expected, margin in ((None, 0.035), (Expected(0.49, 0.55), 0.0)):
        seen = nearest_surface(occluder_margin_m=margin)(with_occluder(), K, expected)
        assert not seen.occluder.any()
        assert seen.nearest_m == pytest.approx(0.35)
        assert seen.hand.numpy()[20:30, 0:60].all()


@pytest.mark.parametrize(
    ("wall_m", "expected"),
    [(1.0, Expected(0.53, 0.58)), (1.4, Expected(0.8, 0.9))],
    ids=["a little", "much, and nothing is where it was expected"],
)
def test_a_hand_that_comes_nearer_is_not_its_own_occluder(
    wall_m: float, expected: Expected
) -> None:
    seen = nearest_surface()(picture(0.5, wall_m), K, expected)
    assert not seen.occluder.any()
    assert seen.hand.numpy()[HAND].all()


def test_what_is_well_behind_a_tracked_hand_is_the_body() -> None:
    depth = picture()
    depth[40:60] = 0.65
    assert hand_of(depth)[40:60].all()
    assert not hand_of(depth, Expected(0.49, 0.55))[40:60].any()


def test_the_segmented_sample_holds_the_true_hand_and_not_the_wall() -> None:
    scene = sample()
    for frame in range(0, 100, 12):
        seen = nearest_surface()(scene.depth_m[frame], scene.k)
        hand = seen.hand.numpy()
        joints = scene.joints_m[frame]
        pixels = (joints @ scene.k.T)[:, :2] / joints[:, 2:]
        u, v = pixels.round().astype(int).T
        # Joints lie inside of the hand; only the tips lie at its very edge.
        assert np.delete(hand[v, u], TIPS).mean() > 0.9
        depth = scene.depth_m[frame][hand]
        assert depth.max() < joints[:, 2].max() + 0.25
        assert seen.nearest_m < joints[:, 2].min() + 0.02


@pytest.mark.parametrize("size", [(40, 60), (143, 260), (240, 320), (20, 3000)])
def test_a_reduced_image_is_opencvs_median_in_the_middle_of_each_block_and_shows_it_there(
    size: tuple[int, int],
) -> None:
    generator = np.random.default_rng(0)
    depth = generator.random(size, np.float32) * (generator.random(size) > 0.3)
    k = np.array([[150.0, 0, 81.3], [0, 152.0, 58.6], [0, 0, 1]])
    small, k_small = reduce_image(depth, k, 3000)
    factor = math.ceil(math.sqrt(depth.size / 3000))
    offset = (factor - 1) // 2
    expected = cv2.medianBlur(depth.astype(np.float32), 3)[offset::factor, offset::factor]
    assert np.array_equal(small, depth if factor == 1 else expected)
    # The 3-D point of a reduced pixel projects onto the pixel that it was taken from.
    back = k @ np.linalg.inv(k_small) @ (3, 2, 1)
    assert back == pytest.approx((offset + 3 * factor, offset + 2 * factor, 1))


def test_a_large_image_is_reduced_below_the_limit_and_shows_no_new_depths() -> None:
    scene = sample()
    large = np.kron(scene.depth_m[0], np.ones((3, 3), np.float32))
    seen = nearest_surface(max_pixels=40_000)(large, scene.k)
    assert seen.depth_m.numel() <= 40_000 * 1.01
    assert np.isin(seen.depth_m.numpy(), scene.depth_m[0]).all()


def nearest_by_a_loop(head: NearestSurface, depth: np.ndarray, valid: np.ndarray) -> float:
    """One speck after the other: the definition."""
    candidates = valid.copy()
    while candidates.any():
        row, column = divmod(int(np.where(candidates, depth, np.inf).argmin()), depth.shape[1])
        nearest = float(depth[row, column])
        near = candidates & (depth <= nearest + head.depth_range_m)
        _, labels = cv2.connectedComponents(near.view(np.uint8), connectivity=4)
        here = labels == labels[row, column]
        if np.count_nonzero(here) * nearest**2 / FOCAL**2 >= head.min_area_m2:
            return nearest
        candidates &= ~here
    return math.inf


@pytest.mark.parametrize("size", [1, 2, 3])
@pytest.mark.parametrize("hand_m", [0.5, 0.9, math.nan])
def test_a_thousand_specks_are_dropped_as_by_a_loop(size: int, hand_m: float) -> None:
    rng = np.random.default_rng(size)
    depth = picture(hand_m)
    depth[rng.random(depth.shape) < 0.2] = 0  # so that specks on the wall hang together less
    for _ in range(1000 // size**2):
        row, column = rng.integers(HEIGHT - size), rng.integers(WIDTH - size)
        depth[row : row + size, column : column + size] = rng.uniform(0.15, 0.8)
    for area, reach in ((0.0008, 0.2), (0.01, 0.02), (9.0, 0.2)):
        head = nearest_surface(min_area_m2=area, depth_range_m=reach)
        valid = (depth > 0) & (depth <= head.max_distance_m)
        seen = head(depth, K)
        assert seen.nearest_m == pytest.approx(nearest_by_a_loop(head, depth, valid))
    assert seen.empty, "nothing is as large as 9 square metres"


def test_an_image_that_must_not_be_written_to_is_segmented() -> None:
    depth = picture()
    depth.flags.writeable = False
    assert nearest_surface()(depth, K).nearest_m == pytest.approx(0.5)


CENTRE = Expected(0.48, 0.52, (0.0, 0.0, 0.5))
"""A tracked hand in the middle of the image."""


def beside(reach_m: float, column: int) -> bool:
    """Whether a thing at the hand's depth in some column of the image is taken for the hand."""
    depth = np.full((HEIGHT, WIDTH), 1.5, np.float32)
    depth[26:37, 34:45] = 0.5
    depth[26:37, column : column + 2] = 0.5
    return bool(hand_of(depth, CENTRE, reach_m=reach_m)[31, column])


def test_what_lies_beside_the_reach_of_a_tracked_hand_is_none_of_it() -> None:
    # 20 pixels are 10 cm at 0.5 m.
    assert beside(0.20, 70) and not beside(0.10, 70)
    assert beside(0.12, 60) and not beside(0.08, 60)
    assert beside(math.inf, 78)


def test_what_lies_beside_the_reach_hides_nothing() -> None:
    depth = np.full((HEIGHT, WIDTH), 1.5, np.float32)
    depth[20:45, 25:52] = 0.5
    depth[:, 72:] = 0.3
    near, far = (
        nearest_surface(reach_m=reach_m)(depth, K, CENTRE).occluder.numpy()
        for reach_m in (0.12, math.inf)
    )
    assert not near.any() and far[:, 72:].all()


def test_a_reach_beyond_the_image_or_behind_the_camera_is_no_error() -> None:
    depth = picture()
    for x, y, z in ((0, 0, 1e-3), (1e6, -1e6, 0.5), (0, 0, 1e9), (-50, 0, 0.1), (0, 0, -0.3)):
        seen = nearest_surface()(depth, K, Expected(0.4, 0.6, (x, y, z)))
        assert seen.hand.shape == depth.shape
