"""Which pixels are the other hand's, and what they may say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.configured import f_measure, nearest_surface

from toftrack.frames import DepthImage
from toftrack.hand.shape import default_hand_shape
from toftrack.render.model_image import model_range_image
from toftrack.render.reference import ReferenceScorer
from toftrack.tracking.hands import OtherHand, explained, pixels_of, without
from toftrack.tracking.posterior import touching

K = np.array([[200.0, 0, 88], [0, 200.0, 72], [0, 0, 1]])
SIZE = (144, 176)
NOTHING = np.zeros(SIZE, np.float32)


def hand_at(x: float, z: float) -> torch.Tensor:
    state = torch.zeros(1, 27)
    state[0, :3] = torch.tensor([x, 0.08, z])
    return state


def surface(x: float, z: float) -> np.ndarray:
    return model_range_image(hand_at(x, z)[0].numpy(), default_hand_shape(), K, *SIZE)


def test_a_pixel_belongs_to_the_hand_that_explains_it_better() -> None:
    mine, theirs = surface(-0.06, 0.5), surface(0.06, 0.55)
    depth = np.where((mine > 0) & ((theirs == 0) | (mine < theirs)), mine, theirs)
    pixels = explained(depth, theirs, mine)
    own = (mine > 0) & ((theirs == 0) | (mine < theirs))
    assert not pixels[own].any(), "none of my own are taken"
    assert pixels[(theirs > 0) & (mine == 0)].all(), "all of the other's are"


def test_a_hand_that_is_not_there_explains_nothing() -> None:
    depth = surface(-0.06, 0.5)
    assert not explained(depth, surface(-0.06, 0.7), NOTHING).any()
    assert not explained(NOTHING, surface(0, 0.5), NOTHING).any()


def test_the_other_hand_hides_what_is_behind_it_and_not_what_is_in_front() -> None:
    theirs = surface(0.0, 0.5)
    segmentation, likelihood = nearest_surface(), f_measure()
    pixels = explained(theirs, theirs, NOTHING)
    observation = segmentation(theirs, K, None, pixels)
    assert not observation.hand.any(), "nothing is left for a second hand"
    evidence = likelihood.evidence(observation)
    scorer = ReferenceScorer(default_hand_shape())
    behind = scorer(hand_at(0.0, 0.7), evidence)
    front = scorer(hand_at(0.0, 0.4), evidence)
    assert float(front.false) > 3 * float(behind.false)


def test_hands_touch_where_their_joints_are_in_one_another() -> None:
    joints = torch.rand(21, 3, generator=torch.Generator().manual_seed(0))
    assert float(touching(joints[None], joints)) == pytest.approx(1.0)
    assert float(touching(joints[None] + 1.0, joints)) == 0.0


def test_the_networks_see_nothing_near_where_the_other_hand_is_beside() -> None:
    depth = np.full((288, 352), 0.5, np.float32)
    beside = np.zeros(SIZE, bool)
    beside[:, :88] = True
    image = DepthImage(depth, K, 0, 0.0)
    other = OtherHand(torch.zeros(21, 3), np.zeros(3), True, True, beside, beside)
    seen = without(image, [other]).depth_m
    assert (seen[:, :176] > 2.0).all() and (seen[:, 176:] == 0.5).all()
    assert without(image, []) is image
    np.testing.assert_array_equal(depth, 0.5, "the image itself is left alone")


def test_only_the_pixels_of_certain_hands_are_taken() -> None:
    left, right = (np.zeros(SIZE, bool) for _ in range(2))
    left[:, :40], right[:, 100:] = True, True
    hands = [OtherHand(torch.zeros(21, 3), np.zeros(3), True, True, at, at) for at in (left, right)]
    np.testing.assert_array_equal(pixels_of(hands), left | right)
    np.testing.assert_array_equal(pixels_of([hands[0], replace(hands[1], certain=False)]), left)
    assert pixels_of([]) is None


def straight_hand(
    wrist_m: tuple[float, float, float], fingers: tuple[float, float, float]
) -> np.ndarray:
    """(21, 3) joints on a line, 18 cm long, from a wrist to where the fingers point."""
    along = np.linspace(0.0, 0.18, 21)[:, None]
    joints = np.array(wrist_m) + along * np.array(fingers) / np.linalg.norm(fingers)
    return joints.astype(np.float32)


def another(joints_m: np.ndarray, certain: bool = True) -> OtherHand:
    none = np.zeros((4, 4), bool)
    return OtherHand(
        torch.from_numpy(joints_m), joints_m[:10].mean(0), True, certain, none, none, True
    )
