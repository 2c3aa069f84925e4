"""What is thought of each joint: from its features, and from particles where there are none."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.configured import confidence_model
from helpers.detection import detection_of
from helpers.tracking import make_tracker, sample

from toftrack.detector.hand_detector import NO_DETECTION
from toftrack.errors import ToftrackError
from toftrack.refinement.gauss_newton import Keypoints
from toftrack.tracking.confidence import (
    COLUMNS,
    JOINT_FEATURES,
    KINDS,
    JointConfidence,
    joint_features,
    propagated_sigma,
)

pytestmark = pytest.mark.usefixtures("one_thread")

K = np.array([[200.0, 0, 87.5], [0, 200.0, 71.5], [0, 0, 1]])
WALL = np.full((144, 176), 0.9, np.float32)
NOTHING = np.zeros((21, len(JOINT_FEATURES)))


def model() -> JointConfidence:
    return confidence_model().joints


def joints_at(z: float = 0.5) -> np.ndarray:
    """(21, 3) joints apart from each other."""
    column, row = np.meshgrid(np.arange(7), np.arange(3))
    flat = np.stack((column.ravel() - 3.0, row.ravel() - 1.0, np.zeros(21)), 1)
    return (0.03 * flat + (0, 0, z)).astype(np.float32)


def features_of(
    joints: np.ndarray, depth: np.ndarray = WALL, **changes: Any
) -> dict[str, np.ndarray]:
    """Features by name; as a rule the networks see the joints where they are."""
    keypoints = Keypoints(torch.from_numpy(joints_at()), torch.full((21,), 0.005))
    detection = replace(detection_of(torch.zeros(1, 27)), keypoints=keypoints)
    given = {"detection": detection, "last": NOTHING, "score": 0.9, "log_odds": 2.0} | changes
    found = joint_features(joints, depth_m=depth, k=K, **given)
    return dict(zip(JOINT_FEATURES, found.T, strict=True))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scale": 0.0}, "joints.scale"),
        ({"odds": math.nan}, "joints.odds"),
        ({"kinds": {"wrist": [0, 0, 0, 0]}}, "kinds must have a row for each of wrist, thumb_cmc"),
        ({"weights": {"luck": [0, 0, 0, 0]}}, "weights must have a row for each of unsure"),
        ({"weights": dict.fromkeys(JOINT_FEATURES, [1, 2])}, "unsure must be 4 numbers: ray"),
        ({"kinds": dict.fromkeys(KINDS, [0, 0, 0, math.inf])}, "joints.kinds.wrist"),
    ],
)
def test_settings_that_cannot_be_are_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ToftrackError, match=words):
        replace(model(), **changes)


@pytest.mark.parametrize("name", JOINT_FEATURES)
def test_the_package_s_confidence_is_never_surer_for_a_feature_against_a_joint(name: str) -> None:
    features = np.zeros((21, len(JOINT_FEATURES)))
    worse = features.copy()
    worse[:, JOINT_FEATURES.index(name)] += 1
    (sigma, confidence), (wider, less) = model().judge(features), model().judge(worse)
    assert (wider >= sigma).all() and (less <= confidence).all()
    assert (wider > sigma).any() or (less < confidence).any()


def test_a_row_of_weights_is_of_its_column_and_kind() -> None:
    nothing = [0.0] * len(COLUMNS)
    kinds = dict.fromkeys(KINDS, nothing) | {"tip": [math.log(2), 0, 0, 1.5]}
    weights = dict.fromkeys(JOINT_FEATURES, nothing) | {"doubt": [0, 0.5, 0, -1.0]}
    features = np.zeros((21, len(JOINT_FEATURES)))
    features[3, JOINT_FEATURES.index("doubt")] = 2.0
    sigma, confidence = JointConfidence(1.0, 0.0, kinds, weights).judge(features)
    expected = np.full((21, 3), 0.01)
    expected[[8, 12, 16, 20], 0] = 0.02
    expected[3, 1] = 0.01 * math.e
    np.testing.assert_allclose(sigma, expected, rtol=1e-5)
    odds = np.log(confidence / (1 - confidence))
    assert odds[[0, 3, 8]] == pytest.approx([0, -2, 1.5], abs=1e-5)


def test_features_and_what_follows_are_finite_whatever_is_seen() -> None:
    for joints in (joints_at(), joints_at() + 100, joints_at() * 1e-6, -joints_at()):
        for depth in (WALL, 0 * WALL):
            for score, log_odds in ((0.0, -1e3), (1.0, 1e3)):
                found = features_of(
                    joints.astype(np.float32), depth, score=score, log_odds=log_odds
                )
                sigma, confidence = model().judge(np.stack(list(found.values()), 1))
                assert np.isfinite(sigma).all() and (sigma > 0).all()
                assert ((confidence >= 0) & (confidence <= 1)).all()


def test_a_joint_away_from_its_keypoint_speaks_against_its_finger() -> None:
    moved = joints_at()
    moved[6] += (0, 0, 0.05)
    before, after = features_of(joints_at()), features_of(moved)
    changed = after["keypoint_off"] > before["keypoint_off"] + 1
    assert np.flatnonzero(changed).tolist() == [6]
    # The wrist stands for the whole hand.
    farther = after["finger_off"] > before["finger_off"] + 1
    assert np.flatnonzero(farther[1:]).tolist() == [4, 5, 6, 7]
    assert after["finger_off"][0] > before["finger_off"][0]  # the wrist: of all


def test_a_hidden_joint_says_so() -> None:
    covered = np.where(np.arange(176) < 60, 0.4, 0.497).astype(np.float32)
    open_, half = (np.broadcast_to(row, WALL.shape) for row in (np.float32(0.497), covered))
    before, after = features_of(joints_at(), open_), features_of(joints_at(), half)
    behind = 200 * joints_at()[:, 0] / 0.5 + 87.5 < 57
    assert 0 < behind.sum() < 21
    assert (before["behind"] == 0).all() and (before["before"] < 0.6).all()
    assert (after["behind"][behind] > 2).all() and (after["behind"][~behind] == 0).all()
    assert (features_of(joints_at())["before"] > 2).all()
    (sigma, sure), (wider, less) = (
        model().judge(np.stack(list(reported.values()), 1)) for reported in (before, after)
    )
    assert (wider[behind] > sigma[behind]).all() and (wider[~behind] == sigma[~behind]).all()
    # Nor any less near for that alone; it is no longer in front of what is seen.
    assert np.abs(less - sure).max() < 0.002 and (less[~behind] == sure[~behind]).all()


def test_what_is_out_of_the_image_or_not_read_is_distinguished() -> None:
    away = joints_at() + np.array([1, 0, 0], np.float32)
    assert (features_of(away)["outside"] == 1).all() and (features_of(away)["unread"] == 0).all()
    blank = features_of(joints_at(), 0 * WALL)
    assert (blank["unread"] == 1).all() and (blank["outside"] == 0).all()
    assert (blank["behind"] == 0).all() and (blank["before"] == 0).all()


def test_without_a_detection_the_last_keypoints_hold_and_the_image_is_read_anew() -> None:
    last = np.stack(list(features_of(joints_at(0.6)).values()), 1)
    found = features_of(joints_at(), 0 * WALL, detection=NO_DETECTION, last=last)
    for column, name in enumerate(JOINT_FEATURES[:3]):
        np.testing.assert_array_equal(found[name], last[:, column])
    assert (found["unread"] == 1).all()


def test_a_covariance_is_carried_to_the_joints() -> None:
    joints = np.tile([0.0, 0.0, 0.5], (21, 1))
    joints[1:, 1] -= 0.02 * np.arange(1, 21)  # all fingers upwards, one line

    def joints_of(tangents: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(joints) + tangents[:, None, :3]

    covariance = torch.diag(torch.tensor([0.003, 0.006, 0.012, 1.0])).square()
    sigma = propagated_sigma(joints, covariance.double(), joints_of)
    # At the wrist, on the optical axis: along z, along the hand (y), across (x).
    np.testing.assert_allclose(sigma[0], [0.012, 0.006, 0.003], rtol=1e-5)


@pytest.mark.parametrize("overrides", [(), ("lost.joint_ok=0.99",), ("experiment=paper",)])
def test_every_estimate_says_how_far_off_its_joints_may_be(overrides: tuple[str, ...]) -> None:
    scene, tracker = sample().cut(0, 1, 2), make_tracker(*overrides)
    for index, depth in enumerate(scene.depth_m):
        estimate = tracker.step(depth, scene.k, index, index / 25)
    assert estimate.joint_sigma_m.shape == (21, 3)
    assert estimate.joint_sigma_m.dtype == estimate.joint_confidence.dtype == np.float32
    assert ((estimate.joint_sigma_m > 5e-4) & (estimate.joint_sigma_m < 0.1)).all()
    assert estimate.joint_ok.shape == (21,) and not estimate.lost
    paper = "experiment=paper" in overrides
    least = 0.0 if paper else tracker.model.lost.joint_ok
    assert (estimate.joint_ok == ~(estimate.joint_confidence < least)).all()
    assert estimate.joint_ok.any()
    known = np.isfinite(estimate.joint_confidence)
    assert known.all() if not paper else not known.any()
    gone = tracker.step(np.zeros_like(depth), scene.k, 3, 3 / 25)
    assert np.isnan(gone.joint_sigma_m).all() and (gone.joint_confidence == 0).all()
    assert gone.joint_ok.dtype == bool and not gone.joint_ok.any()
