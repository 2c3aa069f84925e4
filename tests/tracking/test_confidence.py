"""How surely an estimate is right: by the features of a frame."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from helpers.configured import confidence_model
from helpers.detection import detection_of

from toftrack.detector.hand_detector import NO_DETECTION
from toftrack.errors import ToftrackError
from toftrack.tracking.confidence import (
    FEATURES,
    NO_FEATURES,
    ConfidenceFeatures,
    LogOdds,
    confidence_features,
)

pytestmark = pytest.mark.usefixtures("one_thread")

K = torch.tensor([[200.0, 0, 87.5], [0, 200.0, 71.5], [0, 0, 1]])


def test_a_weight_of_an_unknown_feature_is_refused() -> None:
    with pytest.raises(ToftrackError, match="weights.luck is unknown; the features are log_"):
        LogOdds(0.0, {"luck": 1.0})


@pytest.mark.parametrize(
    ("name", "value"),
    [("confidence", 1.5), ("give_up", -0.1), ("memory", 1.0), ("patience", -1), ("patience", 2.5)],
)
def test_settings_that_cannot_be_are_refused(name: str, value: object) -> None:
    with pytest.raises(ToftrackError, match=f"lost.{name}"):
        confidence_model(**{name: value})


@pytest.mark.parametrize("name", FEATURES)
def test_log_odds_rise_and_fall_with_a_feature_as_its_weight_says(name: str) -> None:
    more = replace(NO_FEATURES, **{name: 1.0})
    for weight in (-0.7, 0.4):
        log_odds = LogOdds(4.0, {name: weight})
        assert log_odds(more) - log_odds(NO_FEATURES) == pytest.approx(weight)
    assert LogOdds(4.0, {})(more) == 4.0


def test_the_package_s_confidence_prefers_good_scores_and_agreement() -> None:
    model = confidence_model()
    off = dict.fromkeys(("keypoints_off", "farthest_keypoint_off", "pose_off"), 2.5)
    worse = replace(NO_FEATURES, log_score=-2.0, **off)
    assert model.log_odds(NO_FEATURES) > model.log_odds(worse)


def palm_at(z: float = 0.5) -> torch.Tensor:
    state = torch.zeros(2, 27)
    state[:, 1:3] = torch.tensor([0.08, z])
    state[1, 3:6] = torch.tensor([0.0, 0.5, 0.0])
    return state


def features_of(
    joints: torch.Tensor, depth: torch.Tensor, score: float = 0.9
) -> ConfidenceFeatures:
    return confidence_features(joints, score, 1.0, detection_of(palm_at()), NO_FEATURES, depth, K)


def test_features_are_of_order_one_and_finite() -> None:
    joints = detection_of(palm_at()).joints_m[0]
    empty, wall = torch.zeros(144, 176), torch.full((144, 176), 0.9)
    for found in (joints, joints + 100.0, joints * 1e-6, joints * -1.0):
        for depth in (empty, wall):
            for score in (0.0, 1.0):
                values = features_of(found, depth, score).values()
                assert all(math.isfinite(value) and abs(value) < 15 for value in values)


def test_an_estimate_as_the_networks_see_it_has_good_features() -> None:
    joints, wall = detection_of(palm_at()).joints_m[0], torch.full((144, 176), 0.9)
    right, wrong = features_of(joints, wall), features_of(joints + 0.1, wall)
    for name in ("keypoints_off", "farthest_keypoint_off", "pose_off", "likeliest_off"):
        assert getattr(right, name) < getattr(wrong, name) - 1
    assert right.unseen == right.hidden == 0 and right.absent < 0.7 and right.other_side < 0.7
    one = joints.clone()
    one[8] += 0.1
    assert features_of(one, wall).farthest_keypoint_off > right.farthest_keypoint_off + 1


def test_in_a_frame_without_a_detection_all_but_the_score_holds() -> None:
    joints, wall = detection_of(palm_at()).joints_m[0], torch.full((144, 176), 0.9)
    last = features_of(joints, wall)
    found = confidence_features(joints + 1.0, 0.5, 1.0, NO_DETECTION, last, wall, K)
    assert found == replace(last, log_score=math.log(0.5))


def test_joints_out_of_sight_are_counted() -> None:
    joints = detection_of(palm_at()).joints_m[0]
    wall = torch.full((144, 176), 0.9)
    assert features_of(joints + torch.tensor([2.0, 0, 0]), wall).unseen == 1
    assert features_of(joints, torch.full((144, 176), 0.3)).hidden == 1
    half = wall.clone()
    u = (200.0 * joints[:, 0] / joints[:, 2] + 87.5).round()
    half[:, : int(u.median())] = 0.3
    assert 0.2 < features_of(joints, half).hidden < 0.8
