"""What stands about in whole training images and is no hand."""

from dataclasses import replace

import numpy as np
import torch
from helpers.detection import clean_picture, dice, distance_to, intrinsics, plain_scenes

from toftrack.training.furniture import PIECES, before_camera, frames, furniture, on_a_piece
from toftrack.training.hands import HAND, OTHER_HAND
from toftrack.training.things_numba import BALL, BOX, CONE, PART

N = 64


def pieces(there: torch.Tensor, seed: int = 0) -> torch.Tensor:
    own = dice(seed)
    return furniture(there, before_camera(len(there), own), own)


def test_where_there_is_furniture_there_are_two_pieces_or_more() -> None:
    there = torch.arange(N) % 2 == 0
    made = pieces(there)
    assert made.shape == (N, PIECES, PART) and made.isfinite().all()
    count = (made[..., 0] >= 0).sum(1)
    assert (count[there] >= 2).all() and (count[~there] == 0).all()
    assert len(count.unique()) > 4
    assert made[..., 0].unique().tolist() == [-1, BOX, CONE, BALL], "of all kinds"
    assert torch.equal(made, pieces(there)) and not torch.equal(made, pieces(there, 1))


def test_pieces_stand_together() -> None:
    made = pieces(torch.ones(N, dtype=torch.bool))
    shown = made[..., 0] >= 0
    middle = (made[..., 1:4] * shown[..., None]).sum(1) / shown.sum(1, keepdim=True)
    away = (made[..., 1:4] - middle[:, None]).norm(dim=-1)[shown]
    assert away.median() < 0.2 and away.max() < 1.5
    assert (made[..., 13:16][shown] >= 0).all() and (made[..., 18][shown] < 1.0).all()


def test_a_place_on_a_piece_is_in_it_or_nearly() -> None:
    made = pieces(torch.ones(N, dtype=torch.bool))
    places = on_a_piece(made, dice()).numpy()
    some = [[part for part in row.numpy().astype(np.float64) if part[0] >= 0] for row in made]
    away = [
        min(distance_to(part, place) for part in row)
        for row, place in zip(some, places.astype(np.float64), strict=True)
    ]
    assert np.median(away) < 0.001 and max(away) < 0.1, "at corners of what is round, beside it"


def test_it_is_seen_and_is_no_hand() -> None:
    none = torch.zeros(N, 1, 3), torch.eye(3).expand(N, 1, 3, 3), torch.full((N, 1), -1)
    scenes = replace(plain_scenes(*none), parts=pieces(torch.ones(N, dtype=torch.bool)))
    depth, labels = clean_picture(scenes, intrinsics(100.0, 80, 96), 80, 96)
    seen = (depth > 0).reshape(N, -1).sum(1)
    assert (seen > 30).mean() > 0.8 and depth[depth > 0].min() > 0.05
    assert not ((labels == HAND) | (labels == OTHER_HAND)).any()


def test_slats_of_a_frame_lie_in_one_plane_and_cross_at_right_angles() -> None:
    middle = torch.tensor([[0.0, 0.0, 0.8]]).expand(N, 3)
    slats = frames(middle, dice())
    rows = slats[..., 4:13].unflatten(-1, (3, 3))
    long, normal = rows[:, :, 1], rows[:, :1, 2]
    off = ((slats[..., 1:4] - middle[:, None]) * normal).sum(-1).abs()
    assert off.max() < 0.04 and off.median() < 0.01
    assert (long * normal).sum(-1).abs().max() < 1e-4
    between = (long[:, :1] * long).sum(-1).abs()
    assert ((between < 1e-4) | (between > 1 - 1e-4)).all() and 0.3 < between.mean() < 0.7
    assert (slats[..., 13] < slats[..., 14]).all() and (slats[..., 15] < 0.02).all()
