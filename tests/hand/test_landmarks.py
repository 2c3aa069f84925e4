"""The joints as MediaPipe's landmarks: its order, its image coordinates."""

from __future__ import annotations

import numpy as np
import pytest

from toftrack.camera import Camera
from toftrack.hand.conventions import image_landmarks
from toftrack.hand.skeleton import JOINT_NAMES

# As MediaPipe's HandLandmark lists them.
MEDIAPIPE = """WRIST THUMB_CMC THUMB_MCP THUMB_IP THUMB_TIP
INDEX_FINGER_MCP INDEX_FINGER_PIP INDEX_FINGER_DIP INDEX_FINGER_TIP
MIDDLE_FINGER_MCP MIDDLE_FINGER_PIP MIDDLE_FINGER_DIP MIDDLE_FINGER_TIP
RING_FINGER_MCP RING_FINGER_PIP RING_FINGER_DIP RING_FINGER_TIP
PINKY_MCP PINKY_PIP PINKY_DIP PINKY_TIP""".split()
CAMERA = Camera(np.array([[200.0, 0, 87.5], [0, 210.0, 71.5], [0, 0, 1]]), 176, 144)


def hand(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.09, 0.09, (21, 3)) + [0, 0, 0.5]


def test_the_joints_are_mediapipe_s_in_its_order() -> None:
    theirs = [name.lower().replace("_finger", "").replace("pinky", "little") for name in MEDIAPIPE]
    assert list(JOINT_NAMES) == theirs


def test_x_and_y_are_parts_of_the_image() -> None:
    found = image_landmarks(hand(), CAMERA.K, (176, 144))
    pixels = CAMERA.project(hand())
    assert np.allclose(found[:, :2] * [176, 144] - 0.5, pixels)
    corner = np.array([[-88.0 / 200, -72.0 / 210, 1.0]])  # of the image, not of the first pixel
    assert np.allclose(image_landmarks(corner, CAMERA.K, (176, 144))[0, :2], 0)


def test_z_is_the_depth_beyond_the_wrist_s_on_the_scale_of_x() -> None:
    joints = np.repeat(hand()[:1], 21, 0)
    joints[1] += [0.01, 0, 0]
    joints[2] += [0, 0, 0.01]
    joints[3] -= [0, 0, 0.01]
    found = image_landmarks(joints, CAMERA.K, (176, 144))
    aside = found[1, 0] - found[0, 0]
    assert found[0, 2] == 0 and found[2, 2] == pytest.approx(aside)
    assert found[3, 2] == pytest.approx(-aside)


def test_leading_axes_stay_and_what_has_no_image_is_nan() -> None:
    joints = np.stack([hand(s) for s in range(6)]).reshape(2, 3, 21, 3)
    joints[0, 1, 5, 2] = -0.2
    joints[1, 2] = np.nan
    found = image_landmarks(joints, CAMERA.K, (176, 144))
    assert np.allclose(found[1, 0], image_landmarks(joints[1, 0], CAMERA.K, (176, 144)))
    assert np.isnan(found[0, 1, 5]).all() and np.isfinite(found[0, 1, 6]).all()
    assert np.isnan(found[1, 2]).all()
