"""A hand hangs on an arm: what an image says of where the arm can be."""

from __future__ import annotations

import math

import numpy as np
import pytest
import roma
import torch
from helpers.configured import nearest_surface
from helpers.tracking import sample

from toftrack.render.forearm import arm_sight, forearm_conflict
from toftrack.render.segmentation import Observation

K = np.array([[200.0, 0, 88], [0, 200.0, 72], [0, 0, 1]])


def observed(image: np.ndarray) -> Observation:
    return nearest_surface()(image.astype(np.float32), K)


def conflict(observation: Observation, wrist_m: np.ndarray, rotvec: np.ndarray) -> np.ndarray:
    return forearm_conflict(
        np.asarray(wrist_m, np.float32), np.asarray(rotvec, np.float32), arm_sight(observation)
    )


def pointing(
    image: np.ndarray, degrees: float, x: float = 0.0, y: float = 0.0, z: float = 0.5
) -> float:
    """The conflict of a hand whose arm leaves its wrist downwards (0) or turned from there."""
    rotvec = [[0.0, 0.0, math.radians(degrees)]]
    return float(conflict(observed(image), np.array([[x, y, z]]), np.array(rotvec))[0])


def scene(behind_m: float = 1.0) -> np.ndarray:
    """An arm 0.5 m away that comes from below and ends in the middle of the image."""
    image = np.full((144, 176), behind_m)
    image[60:, 78:98] = 0.5
    return image


def inside_the_image() -> np.ndarray:
    """The same before a wall, cut off before it leaves the image."""
    image = scene()
    image[110:] = 1.0
    return image


def test_an_arm_where_one_is_in_the_image_is_possible() -> None:
    assert pointing(scene(), 0) == 0


@pytest.mark.parametrize(("degrees", "least"), [(90, 0.3), (135, 0.6), (180, 1), (270, 0.3)])
def test_an_arm_where_the_background_is_in_the_image_is_not(degrees: float, least: float) -> None:
    assert pointing(scene(), degrees) >= least


@pytest.mark.parametrize("degrees", [-30, 30])
def test_a_wrist_may_be_bent(degrees: float) -> None:
    assert pointing(scene(), degrees) == 0


def test_a_place_without_reading_may_hide_a_dark_sleeve() -> None:
    inside = scene(behind_m=0.0)
    inside[130:] = 0.0  # the blob does not leave the image
    assert pointing(inside, 90) == 0


def test_beyond_the_image_there_may_be_an_arm() -> None:
    image = np.full((144, 176), 1.0)
    image[:30, 78:98] = 0.5  # fingers that come from above
    assert pointing(image, 180, y=-0.19) == 0


def test_fingers_do_not_lie_where_the_arm_leaves_the_image() -> None:
    """Turned round on the arm, with the hand for an arm: no background is where it would be."""
    image = scene()
    image[10:60, 78:98] = 0.5
    assert pointing(image, 180) == 1
    assert pointing(image, 0) == 0


def test_the_true_hand_of_the_recording_always_has_its_arm_and_a_turned_one_never() -> None:
    frames = sample()
    for i in range(0, 100, 10):
        wrist, middle = frames.joints_m[i, 0], frames.joints_m[i, 9]
        observation = nearest_surface()(frames.depth_m[i], frames.k)
        arm = (wrist - middle) / np.linalg.norm(wrist - middle)
        side = np.cross(arm, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side)
        for sign in (1, -1):
            turn = np.stack((side, sign * arm, np.cross(side, sign * arm)), 1)
            rotvec = roma.rotmat_to_rotvec(torch.from_numpy(turn)).numpy()
            found = conflict(observation, wrist[None], rotvec[None])[0]
            assert (found == 0) == (sign == 1)


def by_a_loop(
    observation: Observation, wrist: np.ndarray, rotvec: np.ndarray, slack: float
) -> float:
    """The conflict of one hand, pixel by pixel. slack: in parts of the limits, to either side."""
    depth, k = observation.depth_m.numpy().astype(float), observation.k.numpy().astype(float)
    hand, occluder = observation.hand.numpy(), observation.occluder.numpy()
    height, width = depth.shape
    rows, columns = np.mgrid[:height, :width]
    something = hand | occluder | (depth == 0)
    axis = roma.rotvec_to_rotmat(torch.tensor(rotvec)).numpy()[:, 1]

    def pixel(point: np.ndarray) -> tuple[int, int] | None:
        u, v = np.rint(k[:2] @ (point / point[2])).astype(int)
        return (v, u) if 0 <= u < width and 0 <= v < height else None

    through = 0
    for along in (0.05, 0.07, 0.09):
        point = wrist + along * axis
        at = pixel(point)
        if at is None or depth[at] <= point[2] + 0.06:
            continue
        far = np.hypot(rows[something] - at[0], columns[something] - at[1]).min()
        through += far > slack * 0.7 * along * k[0, 0] / point[2]
    border = (rows % (height - 1) == 0) | (columns % (width - 1) == 0)
    leaves = [
        np.array([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], 1.0]) * depth[v, u]
        for v, u in np.argwhere(hand & border)
    ]
    if leaves and pixel(wrist) is not None:
        ahead = max(axis @ point for point in leaves) - axis @ wrist
        if ahead < (1 - slack) * 0.05:
            return 1.0
    return through / 3


@pytest.mark.parametrize("image", [scene(), inside_the_image()], ids=["leaves", "inside"])
def test_the_conflict_is_what_a_loop_over_the_forearm_finds(image: np.ndarray) -> None:
    draw, observation, exact = np.random.default_rng(1), observed(image), 0
    wrists = draw.uniform((-0.12, -0.1, 0.4), (0.12, 0.2, 0.6), (60, 3)).astype(np.float32)
    turns = draw.uniform(-2.5, 2.5, (60, 3)).astype(np.float32)
    found = conflict(observation, wrists, turns)
    for value, wrist, turn in zip(found, wrists.astype(float), turns.astype(float), strict=True):
        # The distances are those of a chamfer mask, and only some of the blob's edge counts.
        most, least = (by_a_loop(observation, wrist, turn, slack) for slack in (0.9, 1.1))
        assert least - 1e-6 <= value <= most + 1e-6
        exact += least == most
    assert exact > 45 and len(np.unique(found.round(3))) >= 3, "the poses tell something"
