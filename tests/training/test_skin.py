"""Skin: one smooth surface about the bones, closed between the fingers."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.detection import clean_picture, dice, intrinsics, plain_scenes, small_bank

from toftrack.hand.skeleton import forward_kinematics
from toftrack.pose_space.base import clamp_to_joint_limits
from toftrack.training.hands import FOREARM, HAND, Hands, posed_hands
from toftrack.training.scenes import Scenes, moved
from toftrack.training.shapes import shape_bank
from toftrack.training.shown_poses import SHOWN, shown_only

HEIGHT, WIDTH = 144, 176
K = intrinsics(260.0, HEIGHT, WIDTH)
N = 6


def hands(name: str, seed: int = 0, left: bool = False) -> Hands:
    """Several hands that show something, their palms to the camera."""
    rows = torch.full((N,), [shown.name for shown in SHOWN].index(name))
    angles = clamp_to_joint_limits(shown_only(N, dice(seed), rows))
    place = torch.tensor([[0.0, 0.0, 0.45]]).expand(N, 3)
    sides = torch.full((N,), left)
    rotation = torch.eye(3).expand(N, 3, 3)
    return posed_hands(small_bank(), place, sides, dice(seed), HAND, rotation, angles)


def scenes(posed: Hands, blend_m: float | None = None) -> Scenes:
    """The hands alone, with a skin of that width, or None for their ellipsoids."""
    labels = torch.where(posed.labels == HAND, posed.labels, -1)
    plain = plain_scenes(posed.centres_m, posed.axes_m, labels)
    if blend_m is None:
        return plain
    covered = posed.labels == HAND
    skins = replace(posed.skins, covered=covered)
    return replace(
        plain,
        skinned=covered,
        skins=skins.primitives[:, None],
        skin_labels=skins.labels(labels)[:, None],
        skin_widths_m=torch.tensor([blend_m, 0.0]).expand(N, 1, 2),
    )


def pictures(scene: Scenes) -> np.ndarray:
    return clean_picture(scene, K, HEIGHT, WIDTH)[0]


@pytest.mark.parametrize("name", ["palm", "fist", "point with thumb"])
def test_skin_lies_about_the_same_hand_as_its_ellipsoids(name: str) -> None:
    posed = hands(name)
    plain, skin = pictures(scenes(posed)), pictures(scenes(posed, 0.003))
    for one, two in zip(plain, skin, strict=True):
        either, both = ((one > 0) | (two > 0)).sum(), ((one > 0) & (two > 0)).sum()
        assert both > 0.8 * either
        shift = np.abs(one - two)[(one > 0) & (two > 0)]
        assert np.median(shift) < 0.005


def test_a_fist_has_no_valleys_as_deep_as_those_of_its_ellipsoids() -> None:
    """Between curled fingers the surface is closed: its steps from pixel to pixel are smaller."""
    posed = hands("fist")

    def steps(images: np.ndarray) -> float:
        step = np.abs(np.diff(images, axis=1))
        inside = (images[:, 1:] > 0) & (images[:, :-1] > 0)
        return float(np.percentile(step[inside], 90))

    assert steps(pictures(scenes(posed, 0.005))) < 0.9 * steps(pictures(scenes(posed)))


def test_a_wider_union_fills_more() -> None:
    posed = hands("flat")
    narrow, wide = (pictures(scenes(posed, width)) for width in (0.0005, 0.005))
    assert ((wide > 0) >= (narrow > 0)).mean() > 0.999
    assert (wide > 0).sum() > 1.02 * (narrow > 0).sum()


def test_the_ends_of_the_fingers_are_their_tips() -> None:
    posed = hands("palm")
    images = pictures(scenes(posed, 0.002))
    for image, joints in zip(images, posed.joints_m.numpy(), strict=True):
        rows = np.flatnonzero((image > 0).any(1))
        highest = (joints[:, 1] / joints[:, 2]).min() * K[1, 1] + K[1, 2]
        assert abs(rows[0] - highest) < 3


def test_a_skin_moves_with_its_scene_and_its_mirror_image_is_a_left_hand() -> None:
    scene = scenes(hands("palm"), 0.003)
    farther = pictures(moved(scene, torch.tensor([[0.0, 0.0, 0.05]]).expand(N, 3)))
    near = pictures(scene)
    assert (farther > 0).sum() < (near > 0).sum()
    assert farther[farther > 0].min() == pytest.approx(near[near > 0].min() + 0.05, abs=2e-3)
    other = pictures(scenes(hands("palm", left=True), 0.003))
    same = (np.abs(other[:, :, ::-1] - near) < 2e-3).mean()
    assert same > 0.995


def test_three_quarters_of_the_hands_have_a_skin_and_sleeves_stay_outside_of_it() -> None:
    n = 600
    place = torch.tensor([[0.0, 0.0, 0.5]]).expand(n, 3)
    posed = posed_hands(small_bank(), place, torch.zeros(n, dtype=torch.bool), dice(3), HAND)
    skinned = posed.skins.covered[:, 0]
    assert 0.69 < float(skinned.float().mean()) < 0.81
    assert (posed.skins.covered[:, :29] == skinned[:, None]).all()
    arms = posed.skins.covered[:, 29:] & (posed.labels[:, 29:] == FOREARM)
    assert 0.3 < float(arms[skinned][:, :5].all(1).float().mean()) < 0.8
    blend = posed.skins.widths_m[:, 0]
    assert (blend >= 0.0015).all() and (blend <= 0.005).all()


def test_last_bones_are_as_long_as_people_s() -> None:
    """Against the other bones, 1 to 1.4 times those of the mean shape."""
    bank = shape_bank(200, torch.Generator().manual_seed(2))
    lengths = bank.shape.bone_lengths_m[:, 1:]
    ratio = (lengths[..., 2] / lengths[..., :2].sum(-1)).mean(1)
    mean = torch.tensor([[21.7, 67.5], [23.0, 74.5], [22.8, 70.0], [21.0, 54.2]])
    ratio = ratio / (mean[:, 0] / mean[:, 1]).mean()
    assert 1.1 < float(ratio.median()) < 1.3
    assert 0.9 < float(ratio.min()) and float(ratio.max()) < 1.6
    state = torch.zeros(200, 27)
    assert forward_kinematics(state, bank.shape).joints_m.isfinite().all()
