"""Estimates say the same hand in every convention: OpenXR's, and MediaPipe's landmarks."""

import copy
from dataclasses import fields, replace

import numpy as np
import pytest
from helpers.hands import SIZE_PX, K, hand_estimate, lost_hand
from helpers.tracking import follow, make_tracker, sample

from toftrack.frames.camera import Camera
from toftrack.frames.estimate import Estimate
from toftrack.hand.conventions import image_landmarks, in_all_conventions
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import JOINT_NAMES

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


# As MediaPipe's HandLandmark lists them.
MEDIAPIPE = """WRIST THUMB_CMC THUMB_MCP THUMB_IP THUMB_TIP
INDEX_FINGER_MCP INDEX_FINGER_PIP INDEX_FINGER_DIP INDEX_FINGER_TIP
MIDDLE_FINGER_MCP MIDDLE_FINGER_PIP MIDDLE_FINGER_DIP MIDDLE_FINGER_TIP
RING_FINGER_MCP RING_FINGER_PIP RING_FINGER_DIP RING_FINGER_TIP
PINKY_MCP PINKY_PIP PINKY_DIP PINKY_TIP""".split()
CAMERA = Camera(np.array([[200.0, 0, 87.5], [0, 210.0, 71.5], [0, 0, 1]]), *SIZE_PX)


def hand(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.09, 0.09, (21, 3)) + [0, 0, 0.5]


def test_the_joints_are_mediapipe_s_in_its_order() -> None:
    theirs = [name.lower().replace("_finger", "").replace("pinky", "little") for name in MEDIAPIPE]
    assert list(JOINT_NAMES) == theirs


def test_x_and_y_are_parts_of_the_image() -> None:
    found = image_landmarks(hand(), CAMERA.K, SIZE_PX)
    pixels = CAMERA.project(hand())
    assert np.allclose(found[:, :2] * SIZE_PX - 0.5, pixels)
    corner = np.array([[-88.0 / 200, -72.0 / 210, 1.0]])  # of the image, not of the first pixel
    assert np.allclose(image_landmarks(corner, CAMERA.K, SIZE_PX)[0, :2], 0)


def test_z_is_the_depth_beyond_the_wrist_s_on_the_scale_of_x() -> None:
    joints = np.repeat(hand()[:1], 21, 0)
    joints[1] += [0.01, 0, 0]
    joints[2] += [0, 0, 0.01]
    joints[3] -= [0, 0, 0.01]
    found = image_landmarks(joints, CAMERA.K, SIZE_PX)
    aside = found[1, 0] - found[0, 0]
    assert found[0, 2] == 0 and found[2, 2] == pytest.approx(aside)
    assert found[3, 2] == pytest.approx(-aside)


def test_leading_axes_stay_and_what_has_no_image_is_nan() -> None:
    joints = np.stack([hand(s) for s in range(6)]).reshape(2, 3, 21, 3)
    joints[0, 1, 5, 2] = -0.2
    joints[1, 2] = np.nan
    found = image_landmarks(joints, CAMERA.K, SIZE_PX)
    assert np.allclose(found[1, 0], image_landmarks(joints[1, 0], CAMERA.K, SIZE_PX))
    assert np.isnan(found[0, 1, 5]).all() and np.isfinite(found[0, 1, 6]).all()
    assert np.isnan(found[1, 2]).all()
