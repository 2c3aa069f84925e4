"""Hands that hold things: the fingers touch them, and nothing is a phone or a hammer."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.detection import (
    clean_picture,
    dice,
    distance_to,
    intrinsics,
    plain_scenes,
    random_hands,
    small_bank,
)

from toftrack.hand.skeleton import ANGLE_LIMITS, forward_kinematics
from toftrack.training import hands as module
from toftrack.training.hands import THING, random_grasps
from toftrack.training.held_things import _PHONE_M
from toftrack.training.things_numba import BALL, BOX, CONE, RING

N = 300


def grasps(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, np.ndarray]:
    """Poses (N, 21) and joints (N, 21, 3) of those hands that hold something, and what they hold
    (N, Q, PART).
    """
    bank = small_bank()
    rows = dice(seed).rows(len(bank.log_size), N)
    shape, surface = bank.rows(rows)
    angles, parts = random_grasps(shape, surface, bank.log_size[rows].exp(), dice(seed))
    joints = forward_kinematics(torch.cat((torch.zeros(N, 6), angles), 1), shape).joints_m
    held = parts[:, 0, 0] >= 0
    assert 0.6 < float(held.float().mean()) < 1
    assert (parts[~held][..., 0] == -1).all(), "the others are bare"
    return angles[held], joints[held].numpy(), parts[held].numpy()


def distances(parts: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Of points to the nearest part of a thing."""
    some = [part for part in parts.astype(np.float64) if part[0] >= 0]
    return np.array([min(distance_to(part, point) for part in some) for point in points])


def test_most_hands_hold_something_and_their_fingers_are_at_it() -> None:
    angles, joints, things = grasps()
    low, high = torch.tensor(ANGLE_LIMITS).unbind(1)
    assert (angles >= low).all() and (angles <= high).all()
    nearest, deepest = [], []
    for hand, parts in zip(joints, things, strict=True):
        # The bones' middles and the joints of each finger.
        chain = hand[1:].reshape(5, 4, 3)
        middles = (chain[:, 1:] + chain[:, :-1]) / 2
        away = distances(parts, middles.reshape(-1, 3)).reshape(5, 3)
        nearest.append(np.sort(away.min(1))[1])
        deepest.append(away.min())
    # A bone lies some 8 mm below the skin that touches; some hands are just letting go.
    assert np.median(nearest) < 0.014 and np.mean(np.array(nearest) < 0.02) > 0.8
    assert np.percentile(deepest, 5) > 0.0


def in_palm(opposed: float, tries: int, monkeypatch) -> tuple[np.ndarray, np.ndarray]:
    """Joints of power grasps and their things, see grasps."""
    monkeypatch.setattr(module, "POWER_SHARE", 1.0)
    monkeypatch.setattr(module, "_OPENED_SHARE", 0.0)
    monkeypatch.setattr(module, "_OPPOSED_SHARE", opposed)
    monkeypatch.setattr(module, "_THUMB_TRIES", tries)
    return grasps()[1:]


def test_thumbs_try_until_their_pads_touch_what_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    touching = []
    at = np.array([[0.3], [0.6], [0.9]])
    for tries in (1, 10):
        ends = [
            distances(parts, hand[3] + at * (hand[4] - hand[3]))
            for hand, parts in zip(*in_palm(0.0, tries, monkeypatch), strict=True)
        ]
        touching.append(np.mean([end.min() < 0.013 for end in ends]))
    assert touching[1] > touching[0] + 0.05


def test_thumbs_about_a_thing_do_not_go_through_fingers(monkeypatch: pytest.MonkeyPatch) -> None:
    joints, _ = in_palm(0.75, 10, monkeypatch)
    along = np.linspace(0, 1, 9)[:, None]
    chains = joints[:, 1:].reshape(-1, 5, 4, 3)
    lines = chains[:, :, :-1, None] + along * (chains[:, :, 1:] - chains[:, :, :-1])[:, :, :, None]
    thumb, fingers = lines[:, 0, 1:].reshape(-1, 18, 3), lines[:, 1:4].reshape(-1, 81, 3)
    nearest = np.linalg.norm(thumb[:, :, None] - fingers[:, None], axis=-1).min((1, 2))
    assert np.mean(nearest > 0.008) > 0.95


def test_no_thing_could_be_a_phone() -> None:
    for seed in range(3):
        _, _, parts = grasps(seed)
        thin, wide, long = np.sort(2 * parts[parts[..., 0] == BOX][:, 13:16], 1).T
        (w0, w1), (l0, l1), (_, t1) = _PHONE_M
        phones = (w0 < wide) & (wide < w1) & (l0 < long) & (long < l1) & (thin < t1)
        assert not phones.any()


def part(kind: int, *sizes: float, edge: float = 0.0, wall: float = 0.0) -> np.ndarray:
    return np.array([kind, 0, 0, 0, *np.eye(3).ravel(), *sizes, edge, wall, 1.0], np.float64)


@pytest.mark.parametrize(
    ("thing", "point", "distance"),
    [
        (part(BALL, 0.02, 0, 0), (0.05, 0, 0), 0.03),
        (part(BOX, 0.01, 0.02, 0.03, edge=0.002), (0.0, 0.05, 0), 0.03),
        (part(BOX, 0.01, 0.02, 0.03), (0.0, 0.0, 0), -0.01),
        (part(CONE, 0.02, 0.02, 0.05), (0.0, 0.0, 0.03), 0.01),
        (part(CONE, 0.02, 0.02, 0.05), (0.0, 0.07, 0.0), 0.02),
        (part(CONE, 0.01, 0.03, 0.05), (0.0, 0.0, 0.0), -0.02 * np.cos(np.arctan(0.2))),
        (part(RING, 0.03, 0.005, 0), (0.0, 0.03, 0.0), -0.005),
        (part(RING, 0.03, 0.005, 0), (0.0, 0.0, 0.0), 0.025),
    ],
)
def test_distances_are_those_of_the_shapes(thing, point, distance: float) -> None:
    assert distance_to(thing, np.array(point)) == pytest.approx(distance, abs=1e-6)


@pytest.mark.parametrize("left", [False, True])
def test_a_thing_is_where_its_hand_is(left: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen from the camera, things lie beside, before or behind the hands that hold them."""
    monkeypatch.setattr(module, "HOLDING", 1.0)
    posed = random_hands(40, 1, left, (0.03, -0.02, 0.5))
    held = (posed.parts[..., 0] >= 0).any(1)
    assert float(held.float().mean()) > 0.5
    middle = (posed.parts[:, 0, 1:4] - posed.pivot_m).norm(dim=1)[held]
    assert float(middle.median()) < 0.09 and float(middle.max()) < 0.25
    scene = plain_scenes(posed.centres_m, posed.axes_m, torch.full_like(posed.labels, -1))
    k = intrinsics(200.0, 120, 160)
    depth, labels = clean_picture(replace(scene, parts=posed.parts), k, 120, 160)
    seen = (labels == THING).any((1, 2))
    assert (seen == held.numpy()).mean() > 0.95
    for row in np.flatnonzero(seen):
        part = posed.parts[row, 0]
        z = depth[row][labels[row] == THING]
        assert abs(z.min() - float(part[3])) < float(part[18]) + 0.25
    assert posed.joints_m.isfinite().all(), "the truth is that of the whole hand"
