"""Pictures of scenes: where the ellipsoids are, and what a sensor makes of them."""

import numpy as np
import pytest
import torch
from helpers.detection import (
    FARTHEST_M,
    alone,
    clean_picture,
    clean_sensors,
    dice,
    intrinsics,
    lens_of,
    one_hand,
    plain_scenes,
    random_hands,
)

from toftrack.hand.surface import Ellipsoids
from toftrack.render.reference import render_range_images
from toftrack.training import pictures
from toftrack.training.hands import BACKGROUND, FOREARM, HAND
from toftrack.training.pictures import random_sensors, take_pictures
from toftrack.training.scenes import Scenes

HEIGHT, WIDTH = 120, 160
K = intrinsics(180.0, HEIGHT, WIDTH)


def plate(depth_m: float) -> Scenes:
    """A wall across the optical axis, and no ellipsoid."""
    none = torch.zeros(1, 1, 3), torch.eye(3)[None, None], torch.full((1, 1), -1)
    return plain_scenes(*none, depth_m)


def sensed(scene: Scenes, seed: int = 1, **terms: float) -> np.ndarray:
    """A picture by a sensor that is clean but for some terms."""
    sensors = clean_sensors(1)
    for name, value in terms.items():
        sensors[:, getattr(pictures, name)] = value
    lens = lens_of(K, HEIGHT, WIDTH)
    return take_pictures(scene, lens, sensors, (HEIGHT, WIDTH), dice(seed))[0][0]


@pytest.mark.parametrize("left", [False, True])
def test_depths_are_those_of_the_closed_form(left: bool) -> None:
    hand = one_hand(int(left), (0.02, -0.03, 0.45), left)
    depth, labels = clean_picture(alone(hand), K, HEIGHT, WIDTH)
    drawn = hand.labels[0] >= 0
    ellipsoids = Ellipsoids(hand.centres_m[:, drawn].double(), hand.axes_m[:, drawn].double())
    true = render_range_images(ellipsoids, torch.from_numpy(K), HEIGHT, WIDTH)[0].numpy()
    seen, wanted = depth[0] > 0, true > 0
    assert wanted.sum() > 500
    assert (seen != wanted).mean() < 1e-3, "but for pixels on the outline"
    both = seen & wanted
    # A pixel on an inner outline may show the one or the other finger.
    assert np.median(np.abs(depth[0] - true)[both]) < 1e-6
    assert (np.abs(depth[0] - true)[both] < 1e-4).mean() > 0.995
    assert (labels[0][seen] == HAND).all() and (labels[0][~seen] == BACKGROUND).all()


def test_each_picture_fills_its_own_part_of_the_array() -> None:
    lens = lens_of(K, 50, 70)
    depth, labels = take_pictures(plate(0.6), lens, clean_sensors(1), (HEIGHT, WIDTH), dice())
    assert depth[0, :50, :70] == pytest.approx(0.6)
    assert not depth[0, 50:].any() and not depth[0, :, 70:].any()
    assert (labels[0, 50:] == -1).all() and (labels[0, :, 70:] == -1).all()


def test_what_is_in_front_hides_what_is_behind() -> None:
    hand = one_hand(0, (0.0, 0.0, 0.5))
    scene = alone(hand)
    ball = torch.tensor([[[0.0, 0.0, 0.3]]]), 0.03 * torch.eye(3)[None, None]
    with_ball = plain_scenes(
        torch.cat((scene.centres_m, ball[0]), 1),
        torch.cat((scene.axes_m, ball[1]), 1),
        torch.cat((scene.labels, torch.tensor([[BACKGROUND]])), 1),
    )
    before, _ = clean_picture(scene, K, HEIGHT, WIDTH)
    depth, labels = clean_picture(with_ball, K, HEIGHT, WIDTH)
    middle = (HEIGHT // 2, WIDTH // 2)
    assert depth[0][middle] == pytest.approx(0.27, abs=1e-3)
    hidden = (before[0] > 0) & (np.abs(depth[0] - before[0]) > 1e-6)
    assert hidden.any() and (depth[0] < before[0])[hidden].all()
    assert (labels[0][hidden] == BACKGROUND).all()


def test_noise_grows_with_the_square_of_the_distance() -> None:
    for distance, factor in ((0.5, 1.0), (1.0, 4.0)):
        off = sensed(plate(distance), NOISE=0.003) - distance
        # 19200 pixels: the deviation of a standard deviation is 0.5 %.
        assert off.std() == pytest.approx(0.003 * factor, rel=0.04)
        assert abs(off.mean()) < 0.0003 * factor


def test_the_terms_of_a_sensor_do_what_they_say() -> None:
    wall = plate(0.5)
    assert sensed(wall) == pytest.approx(0.5)
    assert (sensed(wall, HOLES=0.3) == 0).mean() == pytest.approx(0.3, abs=0.03)
    assert sensed(wall, BIAS=0.01) == pytest.approx(0.51)
    assert not sensed(wall, RANGE=0.4).any()
    steps = sensed(wall, NOISE=0.004, STEP=0.002) / 0.002
    # The step follows the true distance, as 0.5 m has it.
    assert np.abs(steps - np.rint(steps)).max() < 1e-2
    assert 0.001 < (sensed(wall, PATCHES=2.0) == 0).mean() < 0.5

    hand = alone(one_hand(0, (0.0, 0.0, 0.4)))
    scene = plain_scenes(hand.centres_m, hand.axes_m, hand.labels, 0.8)
    clean = sensed(scene)
    assert sensed(scene, BLUR=1.0) == pytest.approx(clean, abs=0.02)
    flying = sensed(scene, FLYING=1.0)
    between = (flying > clean.min() + 0.12) & (flying < 0.79)
    assert between.sum() > 30, "pixels on the edge mix both depths"
    shadow = sensed(scene, SHADOW=8.0) == 0
    assert shadow.any() and (clean[shadow] > 0.79).mean() > 0.8, "cast on what lies behind"


def test_narrow_hollows_seem_deeper_and_nothing_else_does() -> None:
    # Two ridges 4 cm apart before a floor that lies 3 cm behind them, and 40 cm before the wall.
    floor, ridges = 0.5, (-0.02, 0.02)
    centres = torch.tensor([[[0.0, 0.0, floor + 0.02], *[[x, 0.0, 0.49] for x in ridges]]])
    flat = [torch.tensor([0.2, 0.2, 0.02]), *[torch.tensor([0.01, 0.2, 0.02])] * 2]
    axes = torch.stack([axis.diag() for axis in flat])[None]
    scene = plain_scenes(centres, axes, torch.full((1, 3), HAND), 0.9)
    clean, late = sensed(scene), sensed(scene, HOLLOW=1.0)
    deeper = late - clean
    middle = HEIGHT // 2, WIDTH // 2
    depth = clean[middle] - clean[HEIGHT // 2].min()
    assert depth == pytest.approx(0.03, abs=2e-3)
    assert deeper[middle] == pytest.approx(depth, abs=2e-3), "twice as deep"
    assert sensed(scene, HOLLOW=0.5)[middle] - clean[middle] == pytest.approx(depth / 2, abs=2e-3)
    # The floor outside is no hollow, nor is the wall far behind one.
    outside = np.abs(np.arange(WIDTH) - WIDTH / 2) > 0.08 * 180 / 0.5
    assert np.abs(deeper[HEIGHT // 2][outside]).max() < 2e-3
    assert np.abs(deeper[clean > 0.85]).max() == 0


def test_a_dark_sleeve_is_not_read_and_the_hand_is() -> None:
    hands = random_hands(1, 2)
    hands.labels[hands.labels == -1] = FOREARM
    lens = lens_of(K, HEIGHT, WIDTH)
    sensors = clean_sensors(1)
    sensors[:, pictures.DARK] = 1.0
    depth, labels = take_pictures(alone(hands), lens, sensors, (HEIGHT, WIDTH), dice())
    assert (labels == FOREARM).any() and not depth[labels == FOREARM].any()
    assert depth[labels == HAND].all()


def test_sensors_are_within_what_cameras_do() -> None:
    terms = random_sensors(4000, dice())
    assert terms.isfinite().all()
    positive = [i for i in range(pictures.SENSOR_TERMS) if i != pictures.BIAS]
    assert (terms[:, positive] >= 0).all()
    assert terms[:, pictures.BIAS].abs().max() < 0.02
    assert 0 < terms[:, pictures.NOISE].min() and terms[:, pictures.NOISE].max() <= 0.007
    for share in (pictures.FLYING, pictures.HOLES):
        assert terms[:, share].max() < 1
    assert terms[:, pictures.RANGE].min() >= 0.9, "a hand is always within the range"
    # Cameras with structured light throw shadows and have no flying pixels.
    light = terms[:, pictures.SHADOW] > 0
    assert 0.2 < light.float().mean() < 0.3
    assert not terms[light][:, pictures.FLYING].any()
    assert not terms[light][:, pictures.HOLLOW].any(), "they measure no time"


def test_a_left_hand_is_the_mirror_image_of_a_right_one() -> None:
    right, left = (random_hands(1, 4, side, (0.0, 0.05, 0.5)) for side in (False, True))
    mirror = torch.tensor([-1.0, 1.0, 1.0])
    assert torch.allclose(right.joints_m * mirror, left.joints_m, atol=1e-6)
    assert torch.allclose(right.centres_m * mirror, left.centres_m, atol=1e-6)
    one, two = (clean_picture(alone(hand), K, HEIGHT, WIDTH)[0][0] for hand in (right, left))
    assert (np.abs(one[:, ::-1] - two) < 1e-4).mean() > 0.999
    assert (one[one > 0] < FARTHEST_M).all()
