"""Where the tracks' hands are in a frame, and to whom its pixels belong."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from helpers.detection import detection_of
from helpers.rendered import EMPTY, SIZE, WALL_M, K, hand_at, image_of, scene_of, track_of
from helpers.settings import f_measure, nearest_surface

from toftrack.frames.frame import DepthImage
from toftrack.hand.shape import default_hand_shape
from toftrack.render.model_image import model_range_image
from toftrack.render.reference import ReferenceScorer
from toftrack.tracking.scene import Scene, _own
from toftrack.tracking.views import expected_of

LEFT, RIGHT = hand_at(-0.06, 0.5), hand_at(0.06, 0.55)
BOTH = image_of(LEFT, RIGHT)


def surface(hand: torch.Tensor) -> np.ndarray:
    """(H, W) Z of a hand alone, 0 = none."""
    return model_range_image(hand[0].numpy(), default_hand_shape(), K, *SIZE)


def two(image: DepthImage = BOTH, **second: object) -> Scene:
    return scene_of(track_of(LEFT), track_of(RIGHT, **second), image=image)


def visible(hand: torch.Tensor, image: DepthImage = BOTH) -> np.ndarray:
    """(H, W) bool: where an image shows it."""
    drawn = surface(hand)
    return (drawn > 0) & (np.abs(drawn - image.depth_m) < 1e-4)


def test_where_one_hand_passes_before_another_the_pixels_are_the_front_one_s() -> None:
    front, back = hand_at(0.0, 0.45), hand_at(0.03, 0.52)
    image = image_of(front, back)
    owners = scene_of(track_of(back), track_of(front), image=image).owners
    assert (owners[visible(front, image)] == 1).mean() > 0.99
    assert (owners[visible(back, image)] == 0).mean() > 0.9
    assert (owners[image.depth_m == np.float32(WALL_M)] == -1).all()


@pytest.mark.parametrize("changes", [{"confirmed": False}, {"believed_s": 0.2}])
def test_a_hand_that_is_not_reliable_owns_nothing(changes: dict[str, object]) -> None:
    scene = two(**changes)
    assert set(np.unique(scene.owners)) == {-1, 0}
    assert scene.owned_by_others(0) is None
    assert scene.owned_by_others(1)[visible(LEFT)].mean() > 0.99
    assert len(scene.others_joints(0)) == 0 and len(scene.others_joints(1)) == 1


def test_a_hand_that_is_not_in_the_image_owns_nothing() -> None:
    for image in (EMPTY, image_of(), image_of(hand_at(-0.06, 0.7))):
        assert (scene_of(track_of(LEFT), image=image).owners == -1).all()
    assert (scene_of(image=BOTH).owners == -1).all()


def test_in_what_is_unexplained_there_is_no_hand_of_a_track() -> None:
    scene = scene_of(track_of(LEFT), image=BOTH)
    rest = scene.unexplained.depth_m
    assert (rest[visible(LEFT)] > 2.0).mean() > 0.99
    image = scene.image.depth_m
    np.testing.assert_array_equal(rest[visible(RIGHT)], image[visible(RIGHT)])
    assert image[visible(LEFT)].max() < 1.0, "the image itself is left alone"
    alone = scene_of(image=BOTH)
    assert alone.unexplained is alone.image


def test_the_networks_see_a_hand_without_the_other_one_but_with_what_hides_it() -> None:
    scene, alone = two(), scene_of(track_of(LEFT), image=BOTH)
    seen = scene.image_for(0).depth_m
    np.testing.assert_array_equal(seen[visible(LEFT)], scene.image.depth_m[visible(LEFT)])
    assert (seen[visible(RIGHT)] > 2.0).mean() > 0.99
    assert alone.image_for(0) is alone.image
    front, back = hand_at(0.0, 0.4), hand_at(0.03, 0.52)
    image = image_of(front, back)
    scene = scene_of(track_of(back), track_of(front), image=image)
    assert scene.image_for(0).depth_m[visible(front, image)].max() < 0.45


def test_an_image_that_is_larger_than_hands_are_segmented_in_is_cut_out_whole() -> None:
    depth, k = BOTH.depth_m.repeat(3, 0).repeat(3, 1), K.copy()
    k[:2] *= 3
    k[:2, 2] += 1.0
    scene = scene_of(track_of(LEFT), image=DepthImage(depth, k, 0, 0.0))
    rest = scene.unexplained.depth_m
    assert scene.reduced.depth_m.size < rest.size < depth.size
    thinned = visible(LEFT).repeat(3, 0).repeat(3, 1)[::2, ::2]
    assert (rest[thinned] > 2.0).mean() > 0.95


def test_a_hand_is_segmented_without_the_pixels_of_others() -> None:
    expected = expected_of(detection_of(LEFT))
    seen = two().segment(expected, 0).hand.numpy()
    assert seen[visible(LEFT)].mean() > 0.95 and seen[visible(RIGHT)].mean() < 0.05
    assert two(image=image_of(RIGHT)).segment(expected_of(detection_of(RIGHT)), -1).hand.sum() == 0


def test_another_hand_hides_what_is_behind_it_and_not_what_is_in_front() -> None:
    theirs = image_of(hand_at(), wall_m=0.0).depth_m
    observation = nearest_surface()(theirs, K, None, theirs > 0)
    assert not observation.hand.any(), "nothing is left for a second hand"
    scorer, evidence = ReferenceScorer(default_hand_shape()), f_measure().evidence(observation)
    behind, front = (scorer(hand_at(0.0, z), evidence) for z in (0.7, 0.4))
    assert float(front.false) > 3 * float(behind.false)


def test_hands_are_predicted_where_they_move_to() -> None:
    still = track_of(hand_at())
    velocity = torch.zeros_like(still.velocity)
    velocity[0] = 0.8
    scene = scene_of(still, replace(still, velocity=velocity), image=BOTH)
    here, moved = (hand.palm_m for hand in scene.hands)
    assert here == pytest.approx(detection_of(hand_at()).centre_m.numpy(), abs=0.01)
    assert 0.2 * 0.8 * scene.dt_s < moved[0] - here[0] <= 0.8 * scene.dt_s
    assert moved[1:] == pytest.approx(here[1:], abs=1e-3)


@pytest.mark.parametrize("hands", [1, 2, 3])
def test_owners_are_those_of_whole_images(hands: int) -> None:
    """As with operations on whole images; cv2.dilate takes the largest of 3 x 3 pixels."""
    draw, size = np.random.default_rng(hands), (60, 80)
    surfaces = np.zeros((hands, *size), np.float32)
    for row, surface in enumerate(surfaces):
        disc = cv2.circle(np.zeros(size, np.uint8), (30 + 12 * row, 28), 14, 1, -1) > 0
        surface[disc] = 0.5 + 0.03 * row + 0.02 * draw.random(np.count_nonzero(disc))
    near = np.where(surfaces > 0, surfaces, 0.8).min(0) + 0.012 * draw.standard_normal(size)
    depth = np.where(draw.random(size) < 0.2, 0, near + 0.05 * (draw.random(size) < 0.3))
    depth, reliable = depth.astype(np.float32), np.arange(hands) != 1
    there = (surfaces > 0) & (depth > 0)
    off = np.where(there, np.abs(surfaces - depth), np.inf)
    nearest, sure = off.argmin(0), off.min(0) < 0.02
    expected = np.full(size, -1, np.int8)
    for row in np.flatnonzero(reliable):
        own = sure & (nearest == row)
        around = cv2.dilate(np.where(own, surfaces[row], 0), np.ones((3, 3)))
        mixed = (around > 0) & ~sure & (depth > around) & (depth < around + 0.06)
        expected[own | mixed] = row
    found = np.full(size, -1, np.int8)
    _own(depth, surfaces, reliable, np.empty_like(found), found)
    np.testing.assert_array_equal(found, expected)
