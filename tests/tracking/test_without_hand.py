"""Recordings that show no hand, or nothing, or another size every frame; by the defaults."""

import numpy as np
import pytest
from helpers.rendered import K
from helpers.tracking import errors_mm, make_tracker, sample


def wall(distance_m: float) -> np.ndarray:
    return np.full((144, 176), distance_m, np.float32)


def ball(distance_m: float, radius_m: float) -> np.ndarray:
    """In the middle of the image, before a wall."""
    depth = wall(1.3)
    v, u = np.mgrid[:144, :176]
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    a, c = x**2 + y**2 + 1, distance_m**2 - radius_m**2
    root = distance_m**2 - a * c
    hit = root > 0
    depth[hit] = ((distance_m - np.sqrt(np.maximum(root, 0))) / a)[hit]
    return depth


@pytest.mark.parametrize(
    "scene",
    [wall(0.2), wall(0.6), wall(1.0), ball(0.5, 0.07), wall(0.0)],
    ids=["at the lens", "near", "far", "ball", "none"],
)
def test_a_recording_without_a_hand_is_lost_in_every_frame(scene: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    tracker = make_tracker()
    for i in range(6):
        noise = rng.normal(0, 0.003, scene.shape)
        depth = np.where(scene > 0, scene + noise, 0).astype(np.float32)
        estimate = tracker.step(depth, K, i, i / 25)
        assert estimate.lost
        assert (estimate.index, estimate.timestamp_s) == (i, i / 25)


@pytest.mark.parametrize("blank", [1, 3])
def test_images_without_readings_do_not_end_a_track_unless_they_are_many(blank: int) -> None:
    scene, tracker = sample(), make_tracker()
    numbers = []
    for i in range(20):
        gone = 8 <= i < 8 + blank or i >= 12
        depth = np.zeros_like(scene.depth_m[i]) if gone else scene.depth_m[i]
        estimate = tracker.step(depth, scene.k, i, i / 25)
        assert estimate.lost == gone
        numbers.append([track.number for track in tracker.state.tracks])
    assert numbers[:12] == [[0]] * 12 and numbers[-1] == []


def test_no_number_is_no_reading_to_the_networks_too() -> None:
    scene, found = sample(), []
    for nothing in (0.0, np.nan, np.inf, -1.0):
        rng, tracker = np.random.default_rng(0), make_tracker()
        for i in range(3):
            holes = rng.random(scene.depth_m[i].shape) < 0.05
            depth = np.where(holes, np.float32(nothing), scene.depth_m[i])
            estimate = tracker.step(depth, scene.k, i, i / 25)
        found.append(estimate)
    for other in found[1:]:
        assert np.array_equal(other.joints_m, found[0].joints_m)
        assert other.confidence == found[0].confidence
    assert errors_mm(found[:1], scene.cut(2))[0] < 40


def test_images_may_change_their_size_from_frame_to_frame() -> None:
    scene, tracker = sample(), make_tracker()
    found = []
    for i in range(6):
        depth, k = scene.depth_m[i], scene.k.copy()
        if i % 3 == 1:
            depth = np.repeat(np.repeat(depth, 2, 0), 2, 1)
            k[:2] *= 2
            k[:2, 2] += 0.5
        elif i % 3 == 2:  # cut at the sides, where there is no hand
            depth = np.ascontiguousarray(depth[4:, 6:-2])
            k[:2, 2] -= (6, 4)
        found.append(tracker.step(depth, k, i, i / 25))
    assert all(np.isfinite(estimate.joints_m).all() for estimate in found)
    assert errors_mm(found, scene)[-1] < 40


@pytest.mark.parametrize("shape", [(3, 3), (1, 1), (1, 176), (144, 1)])
def test_tiny_images_are_lost_and_no_error(shape: tuple[int, int]) -> None:
    scene, tracker = sample(), make_tracker()
    tracker.step(scene.depth_m[0], scene.k, 0, 0.0)
    k = scene.k.copy()
    k[:2, 2] = (shape[1] / 2, shape[0] / 2)
    k[0, 0] = k[1, 1] = 2 * max(shape)
    for i in range(1, 4):
        tiny = np.full(shape, 0.5, np.float32)
        assert tracker.step(tiny, k, i, i / 25).lost
    found = tracker.step(scene.depth_m[4], scene.k, 4, 4 / 25)
    assert np.isfinite(found.joints_m).all()
