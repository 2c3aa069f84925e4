"""Flying pixels are left out, and surfaces and thin fingers are not."""

import cv2
import numpy as np
import pytest
from helpers.tracking import sample

from toftrack.api import make_hands_tracker
from toftrack.detector.flying_pixels import without_flying_pixels

FOCAL = 200.0
K = np.array([[FOCAL, 0, 43.5], [0, FOCAL, 35.5], [0, 0, 1]])
SIZE = (72, 88)
WIDTHS = 8.0


def left(depth: np.ndarray, widths: float = WIDTHS) -> np.ndarray:
    return without_flying_pixels(depth, K, widths)


def fingers(width_px: int) -> np.ndarray:
    """Upright fingers in front of a wall, each so wide."""
    depth = np.full(SIZE, 1.2, np.float32)
    for first in range(10, 70, 12):
        depth[10:60, first : first + width_px] = 0.5
    return depth


@pytest.mark.parametrize("degrees", [0, 60, 75])
def test_a_surface_stays_however_it_is_inclined(degrees: int) -> None:
    # Z of the plane that holds the axis' point at 0.5 m: z (1 - x tan) = 0.5.
    x = (np.arange(SIZE[1]) - K[0, 2]) / FOCAL
    z = 0.5 / np.maximum(1 - x * np.tan(np.radians(degrees)), 0.2)
    depth = np.broadcast_to(z.astype(np.float32), SIZE).copy()
    seen = np.broadcast_to(z < 0.9, SIZE)
    assert np.array_equal(left(depth)[seen], depth[seen])


@pytest.mark.parametrize("width_px", [1, 2, 4])
def test_a_finger_stays_however_thin_it_is(width_px: int) -> None:
    depth = fingers(width_px)
    gone = left(depth) != depth
    assert gone.sum() <= (2 * 5 if width_px == 1 else 0)  # the ends of a line of single pixels


def test_what_lies_between_a_hand_and_the_wall_goes() -> None:
    depth, rng = fingers(4), np.random.default_rng(0)
    mixed = np.zeros(SIZE, bool)
    mixed[12:58, 14:70:12] = True  # to the right of each finger
    depth[mixed] = rng.uniform(0.55, 1.15, mixed.sum())
    found = left(depth)
    assert (found[mixed] == 0).mean() > 0.9
    assert np.array_equal(found[~mixed], depth[~mixed])


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 2), (200, 700)])
def test_it_agrees_with_counting_in_numpy(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    depth = (0.5 + 0.1 * rng.random(size)).astype(np.float32)
    depth[rng.random(size) < 0.2] = 0
    near = np.float32(WIDTHS / FOCAL) * depth
    around = np.pad(depth, 1, constant_values=np.inf)
    alike = np.full(size, -1)  # each is like itself
    for row in range(3):
        for column in range(3):
            other = around[row : row + size[0], column : column + size[1]]
            alike += np.abs(other - depth) < near
    expected = np.where(alike >= 2, depth, 0)
    expected[:, [0, -1]] = depth[:, [0, -1]]
    assert np.array_equal(left(depth), expected)


def test_without_widths_all_stay() -> None:
    depth = np.random.default_rng(2).random(SIZE, np.float32)
    assert left(depth, 0.0) is depth


def test_the_network_sees_a_hand_with_flying_pixels_more_as_it_is_without_them() -> None:
    scene, detector = sample(), make_hands_tracker().model.detector
    rng, off = np.random.default_rng(3), []
    for row in range(0, len(scene), 5):
        clean, wrist = scene.depth_m[row], scene.joints_m[row, 0]
        palm = (0.5 * (wrist + scene.joints_m[row, 9]))[None]
        full, window = np.where(clean > 0, clean, np.float32(2)), np.ones((3, 3), np.uint8)
        near, far = cv2.erode(full, window), cv2.dilate(full, window)
        mixed = near + rng.random(clean.shape) ** 2 * np.minimum(far - near, 0.6)
        flying = np.where(far - near > 0.03, mixed, clean).astype(np.float32)
        images = clean, flying, without_flying_pixels(flying, scene.k, detector.settings.flying)
        seen = [detector.detect(image, scene.k, palm, "right")[0] for image in images]
        points = [one.keypoints.points_m.numpy() for one in seen]
        off.append([np.linalg.norm(one - points[0], axis=1).mean() for one in points[1:]])
    with_them, without = np.mean(off, 0)
    assert without < 0.8 * with_them
