"""What the pose network says of pixels is said of the right ones."""

import numpy as np
import pytest

from toftrack.detector.crops import CROP_M, crop_rotation
from toftrack.detector.network import PARTS, SEGMENTS
from toftrack.detector.parts import UNKNOWN_PART, Parts

CENTRE = np.array([0.1, -0.05, 0.5])
TURN = crop_rotation(CENTRE, np.array([1.0, -0.4, 0.2]))
DISTANCE = float(np.linalg.norm(CENTRE))
K = np.array([[150.0, 0, 60.0], [0, 160.0, 70.0], [0, 0, 1]])


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_pixel_has_the_class_of_the_part_in_which_it_is_seen_if_any(mirrored: bool) -> None:
    draw = np.random.default_rng(0)
    kind = draw.integers(0, SEGMENTS, (PARTS, PARTS)).astype(np.uint8)
    depth, asked = (
        draw.uniform(0.3, 0.7, (120, 200)).astype(np.float32),
        draw.random((120, 200)) < 0.9,
    )
    row, column = np.indices(depth.shape)
    rays = np.stack(
        ((column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1], np.ones_like(depth)), 2
    )
    flip = np.array([-1.0 if mirrored else 1.0, 1.0, 1.0])
    across, down, away = np.moveaxis(depth[..., None] * rays * flip @ TURN, 2, 0)
    scale = DISTANCE / CROP_M / away
    place = np.floor(PARTS * (np.stack((down * scale, across * scale)) + 0.5)).astype(int)
    shown = ((place >= 0) & (place < PARTS)).all(0) & (np.abs(away - DISTANCE) < CROP_M / 2) & asked
    expected = np.full(depth.shape, UNKNOWN_PART)
    expected[shown] = kind[place[0][shown], place[1][shown]]
    assert 0.02 < shown.mean() < 0.9
    found = Parts(kind, TURN, CENTRE, mirrored).seen(depth, asked, K)
    assert np.array_equal(found, expected)
