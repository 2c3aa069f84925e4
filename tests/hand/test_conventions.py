"""Estimates say the same hand in every convention."""

from __future__ import annotations

import copy
from dataclasses import fields, replace

import numpy as np
import pytest
from helpers.hands import SIZE_PX, K, hand_estimate, lost_hand
from helpers.tracking import follow, make_tracker, sample

from toftrack.estimate import Estimate
from toftrack.hand.conventions import image_landmarks, in_all_conventions
from toftrack.hand.shape import default_hand_shape

FIELDS = ("landmarks", "openxr_position_m", "openxr_orientation", "openxr_radius_m")


@pytest.mark.parametrize("side", ["right", "left"])
def test_all_speak_of_the_same_joints(side: str) -> None:
    estimate = hand_estimate(3, side, bent=0.4)
    index_dip = estimate.joints_m[7]
    assert np.allclose(estimate.openxr_position_m[9], index_dip * [1, -1, -1], atol=1e-6)
    there = image_landmarks(estimate.joints_m, K, SIZE_PX)
    assert np.allclose(estimate.landmarks, there, atol=1e-6)
    assert (estimate.openxr_radius_m > 0).all()


def test_what_was_never_found_is_unknown_in_all_of_them() -> None:
    estimate = in_all_conventions(lost_hand(0), default_hand_shape(), K, SIZE_PX)
    assert all(np.isnan(getattr(estimate, name)).all() for name in FIELDS)


def test_the_tracker_s_estimates_have_them_and_keep_them_while_the_hand_is_gone() -> None:
    scene = sample().cut(0)
    (found,) = follow(scene)
    assert np.allclose(found.openxr_position_m[1], found.joints_m[0] * [1, -1, -1], atol=1e-6)
    tracker = make_tracker()
    tracker.step(scene.depth_m[0], scene.k, 0, 0.0)
    gone = tracker.step(np.zeros_like(scene.depth_m[0]), scene.k, 1, 0.04)
    assert gone.lost
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(gone, name), getattr(found, name))
    assert replace(found).landmarks.shape == (21, 3)


def test_they_are_computed_when_they_are_read_and_go_along_into_copies() -> None:
    asked = []

    def landmarks() -> np.ndarray:
        asked.append(1)
        return np.ones((21, 3))

    estimate = hand_estimate(0).updated(landmarks=landmarks)
    later = estimate.updated(compute_s=1.0)
    assert later.compute_s == 1.0 and not asked
    for copied in (copy.copy(later), copy.deepcopy(later), replace(later)):
        assert (copied.landmarks == 1).all()
        assert copied.values().keys() == {field.name for field in fields(Estimate)}
    assert later.landmarks is later.landmarks
    assert len(asked) == 1
