"""A hand hangs on an arm, and does not turn round all at once: hypotheses that cannot be."""

from __future__ import annotations

import math

import numpy as np
import pytest
import roma
import torch
from helpers.configured import nearest_surface, prior
from helpers.tracking import sample

from toftrack.render.segmentation import Observation
from toftrack.tracking.prior import LastSeen, arm_sight, forearm_conflict

K = np.array([[200.0, 0, 88], [0, 200.0, 72], [0, 0, 1]])


def seen(image: np.ndarray) -> Observation:
    return nearest_surface()(image.astype(np.float32), K)


def pointing(degrees: float, x: float = 0.0, y: float = 0.0, z: float = 0.5) -> torch.Tensor:
    """A particle whose arm leaves its wrist downwards (0) or turned from there."""
    turn = torch.tensor([0.0, 0.0, math.radians(degrees)])
    return torch.cat((torch.tensor([x, y, z]), turn, torch.zeros(4)))[None]


def scene(behind_m: float = 1.0) -> np.ndarray:
    """An arm 0.5 m away that comes from below and ends in the middle of the image."""
    image = np.full((144, 176), behind_m)
    image[60:, 78:98] = 0.5
    return image


def test_an_arm_where_one_is_seen_is_possible() -> None:
    assert float(forearm_conflict(pointing(0), arm_sight(seen(scene())))) == 0


@pytest.mark.parametrize(("degrees", "least"), [(90, 0.3), (135, 0.6), (180, 1), (270, 0.3)])
def test_an_arm_where_the_background_is_seen_is_not(degrees: float, least: float) -> None:
    assert float(forearm_conflict(pointing(degrees), arm_sight(seen(scene())))) >= least


@pytest.mark.parametrize("degrees", [-30, 30])
def test_a_wrist_may_be_bent(degrees: float) -> None:
    assert float(forearm_conflict(pointing(degrees), arm_sight(seen(scene())))) == 0


def test_a_place_without_reading_may_hide_a_dark_sleeve() -> None:
    inside = scene(behind_m=0.0)
    inside[130:] = 0.0  # the blob does not leave the image
    assert float(forearm_conflict(pointing(90), arm_sight(seen(inside)))) == 0


def test_beyond_the_image_there_may_be_an_arm() -> None:
    image = np.full((144, 176), 1.0)
    image[:30, 78:98] = 0.5  # fingers that come from above
    above = pointing(180, y=-0.19)
    assert float(forearm_conflict(above, arm_sight(seen(image)))) == 0


def test_fingers_do_not_lie_where_the_arm_leaves_the_image() -> None:
    """Turned round on the arm, with the hand for an arm: nothing is seen through, and yet."""
    image = scene()
    image[10:60, 78:98] = 0.5
    sight = arm_sight(seen(image))
    assert float(forearm_conflict(pointing(180), sight)) == 1
    assert float(forearm_conflict(pointing(0), sight)) == 0


def test_the_true_hand_of_the_recording_always_has_its_arm_and_a_turned_one_never() -> None:
    frames = sample()
    for i in range(0, 100, 10):
        wrist, middle = frames.joints_m[i, 0], frames.joints_m[i, 9]
        sight = arm_sight(nearest_surface()(frames.depth_m[i], frames.k))
        arm = torch.from_numpy((wrist - middle) / np.linalg.norm(wrist - middle)).float()
        side = torch.linalg.cross(arm, torch.tensor([0.0, 0.0, 1.0]))
        side = side / side.norm()
        for sign in (1, -1):
            columns = (side, sign * arm, torch.linalg.cross(side, sign * arm))
            turn = roma.rotmat_to_rotvec(torch.stack(columns, 1))
            x = torch.cat((torch.from_numpy(wrist).float(), turn, torch.zeros(4)))[None]
            assert (float(forearm_conflict(x, sight)) == 0) == (sign == 1)


def test_a_hand_as_last_seen_is_preferred_and_forgotten_with_time() -> None:
    frame = seen(scene())
    before = torch.zeros(1, 10)
    before[:, 2] = 0.5
    turned = before.clone()
    turned[:, 5] = 3.0
    log_prior = prior(forearm=0.0)
    both = torch.cat((before, turned))

    def gain(age_s: float) -> float:
        same, other = log_prior(frame, LastSeen(before, age_s))(both)
        return float(same - other)

    assert gain(0.0) == pytest.approx(log_prior.memory, abs=0.01)
    assert gain(log_prior.memory_s) == pytest.approx(log_prior.memory / math.e, abs=0.01)
    assert not log_prior(frame, None)(both).any()


def test_an_arm_that_cannot_be_costs_what_is_set() -> None:
    both = torch.cat((pointing(0), pointing(180)))
    possible, turned = prior(forearm=0.4)(seen(scene()), None)(both)
    assert (float(possible), float(turned)) == (0.0, pytest.approx(-0.4))
    assert not prior(forearm=0.0)(seen(scene()), None)(both).any()
