"""What the pose network says of pixels is said of the right ones."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from toftrack.detector.crops import CROP_M, crop_rotation
from toftrack.detector.network import CELLS, PARTS, SEGMENTS
from toftrack.detector.parts import ALL_HAND, BACKGROUND_PART, HAND_PART, Parts, likeliest_parts

CENTRE = np.array([0.1, -0.05, 0.5])
TURN = crop_rotation(CENTRE, np.array([1.0, -0.4, 0.2]))
DISTANCE = float(np.linalg.norm(CENTRE))


def of_parts(depth_m: float) -> np.ndarray:
    """(PARTS * PARTS, 3) seen points in the middles of all parts, row by row, camera frame."""
    steps = (np.arange(PARTS) + 0.5) / PARTS - 0.5
    across, down = (axis.ravel() * CROP_M / DISTANCE for axis in np.meshgrid(steps, steps))
    return depth_m * np.stack((across, down, np.ones_like(across)), 1) @ TURN.T


def test_the_likeliest_class_of_each_part_is_that_of_the_reference() -> None:
    painted = torch.randn(4 * SEGMENTS, CELLS, CELLS, generator=torch.Generator().manual_seed(0))
    expected = F.pixel_shuffle(painted[None], PARTS // CELLS)[0].argmax(0)
    assert np.array_equal(likeliest_parts(painted.numpy()), expected.numpy())


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_seen_point_has_the_class_of_the_part_in_which_it_is_seen(mirrored: bool) -> None:
    kind = np.random.default_rng(0).integers(0, SEGMENTS, (PARTS, PARTS)).astype(np.uint8)
    parts = Parts(kind, TURN, CENTRE, mirrored)
    flip = np.array([-1.0 if mirrored else 1.0, 1.0, 1.0])
    for depth in (DISTANCE - 0.1, DISTANCE, DISTANCE + 0.1):
        assert np.array_equal(parts.at(of_parts(depth) * flip), kind.ravel())


def test_what_the_crop_does_not_show_is_background() -> None:
    parts = Parts(np.full((PARTS, PARTS), HAND_PART, np.uint8), TURN, CENTRE, False)
    behind, before = of_parts(DISTANCE + 0.16), of_parts(DISTANCE - 0.16)
    beside = CENTRE + 0.16 * np.stack((TURN[:, 0], -TURN[:, 0], TURN[:, 1], -TURN[:, 1]))
    for points in (behind, before, beside, np.zeros((1, 3)), -CENTRE[None]):
        assert (parts.at(points) == BACKGROUND_PART).all()


def test_where_nothing_is_said_all_is_the_hand() -> None:
    assert (ALL_HAND.kind == HAND_PART).all()
