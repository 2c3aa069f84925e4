"""Posed hands: held as people hold what they show."""

import math

import pytest
import torch
from helpers.detection import dice, random_hands

from toftrack.training.hands import (
    ABOVE,
    FRONT,
    HEAD,
    UPRIGHT_THUMBS,
    VIEW_SHARES,
    random_rotations,
    random_views,
    thumb_is_up,
    upright_thumbs,
)
from toftrack.training.shown_poses import SHOWN, shown_only

N = 1500


def test_thumbs_that_are_up_are_distinguished() -> None:
    own = dice()
    shares = {}
    for row, shown in enumerate(SHOWN):
        angles = shown_only(200, own, torch.full((200,), row))
        shares[shown.name] = float(thumb_is_up(angles).float().mean())
    assert shares["thumb up"] > 0.7
    assert max(shares[name] for name in ("fist", "palm", "point with thumb", "four")) < 0.2


def test_most_thumbs_that_are_up_are_upright_in_the_image() -> None:
    posed = random_hands(N, 2)
    up = thumb_is_up(posed.angles) & (posed.parts[:, 0, 0] < 0)
    assert up.sum() > 20
    # The hand's x axis points to the thumb, the image's y axis down.
    sides = posed.rotation[:, 1, 0]
    upright = (sides < -math.cos(0.8)).float()
    assert float(upright[up].mean()) > 0.8 * UPRIGHT_THUMBS
    assert float(upright[~up].mean()) < 0.4
    every = upright_thumbs(N, dice())
    assert torch.allclose(every @ every.mT, torch.eye(3).expand(N, 3, 3), atol=1e-5)


def test_forearms_come_from_below_and_from_the_camera_where_that_is_on_the_head() -> None:
    def forearm(view: int) -> torch.Tensor:
        return random_rotations(N, dice(), torch.full((N,), view))[:, :, 1].median(0).values

    head, front = forearm(HEAD), forearm(FRONT)
    assert head[1] > 0.4 and head[2] < -0.2
    assert front[2] > head[2] + 0.2


def test_hands_lie_flat_where_a_camera_is_above_a_table() -> None:
    rotations = random_rotations(N, dice(), torch.full((N,), ABOVE))
    back = rotations[:, 2, 2]
    assert float((back < -0.7).float().mean()) > 0.4, "backs are seen more often than palms"
    views = random_views(20 * N, dice())
    shares = torch.bincount(views, minlength=3) / len(views)
    assert shares.tolist() == pytest.approx(VIEW_SHARES, abs=0.015)
