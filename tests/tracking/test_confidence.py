"""Belief from the networks, the score and the image: by signs, over time."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from helpers.configured import calibrated_belief
from helpers.detection import detection_of

from toftrack.compute.pace import FRAME_S
from toftrack.errors import ToftrackError
from toftrack.tracking.confidence import ConfidenceModel
from toftrack.tracking.features import FEATURES, ConfidenceFeatures, confidence_features
from toftrack.tracking.state import Track

pytestmark = pytest.mark.usefixtures("one_thread")

GOOD = ConfidenceFeatures(
    log_score=-0.1,
    keypoints_off=0.0,
    farthest_keypoint_off=0.5,
    pose_off=0.0,
    likeliest_off=0.0,
    expected_error=0.0,
    unsure=-0.5,
    absent=-4.0,
    other_side=-3.0,
    unseen=0.0,
    hidden=0.0,
    young=0.0,
)
K = torch.tensor([[200.0, 0, 87.5], [0, 200.0, 71.5], [0, 0, 1]])


def belief_of(**changes: object) -> ConfidenceModel:
    """Of the score alone: log odds 4 at a good score, 0 at 2 below, and so on; no memory."""
    usual = {"memory": 0.0, "intercept": 4.0, "weights": {"log_score": 2.0}}
    numbers = {"confidence": 0.5, "give_up": 0.1, "patience": 5}
    return calibrated_belief(**(usual | numbers | changes))


def with_odds(log_odds: float, **changes: float) -> ConfidenceFeatures:
    """Signs that such a belief takes for these log odds."""
    return replace(GOOD, log_score=(log_odds - 4.0) / 2.0, **changes)


def followed(**changes: object) -> Track:
    nothing = torch.zeros(1, 10)
    track = Track(
        nothing, torch.ones(1), nothing, nothing[0], torch.zeros(21), torch.zeros(1, 27), age_s=1.0
    )
    return replace(track, **changes)


def test_a_weight_of_an_unknown_sign_is_one_sentence() -> None:
    with pytest.raises(ToftrackError, match="lost.weights.luck is unknown; the signs are log_"):
        belief_of(weights={"luck": 1.0})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("confidence", 1.5),
        ("give_up", -0.1),
        ("memory", 1.0),
        ("patience", -1),
        ("patience", 2.5),
        ("probation", -1),
        ("intercept", math.nan),
        ("weights", {"young": math.inf}),
    ],
)
def test_settings_that_cannot_be_are_refused(name: str, value: object) -> None:
    with pytest.raises(ToftrackError, match=f"lost.{name}"):
        belief_of(**{name: value})


@pytest.mark.parametrize("name", FEATURES)
def test_log_odds_rise_and_fall_with_a_sign_as_its_weight_says(name: str) -> None:
    more = replace(GOOD, **{name: getattr(GOOD, name) + 1.0})
    for weight in (-0.7, 0.4):
        belief = belief_of(weights={name: weight})
        assert belief.log_odds(more) - belief.log_odds(GOOD) == pytest.approx(weight)
    assert belief_of(weights={}).log_odds(more) == 4.0


@pytest.mark.parametrize("log_odds", [-1e9, -40.0, -2.0, 0.1, 3.0, 1e9])
def test_the_confidence_is_the_probability_of_the_log_odds(log_odds: float) -> None:
    found = belief_of().judge(followed(), with_odds(log_odds), FRAME_S)
    assert found.confidence == pytest.approx(1 / (1 + math.exp(-max(min(log_odds, 50), -50))))
    assert 0 <= found.confidence <= 1
    assert found.lost == (found.confidence < 0.5)


def test_the_package_s_belief_prefers_good_scores_and_agreement() -> None:
    belief = calibrated_belief()
    worse = replace(
        GOOD, log_score=-2.0, keypoints_off=2.5, farthest_keypoint_off=3.0, pose_off=2.5
    )
    assert belief.log_odds(GOOD) > belief.log_odds(worse)


@pytest.mark.parametrize("fps", [12.5, 25.0, 50.0, 100.0])
def test_belief_is_smoothed_over_time_whatever_the_frame_rate(fps: float) -> None:
    belief = belief_of(memory=0.6)
    track = followed(log_odds=5.0)
    for _ in range(round(0.24 * fps)):
        found = belief.judge(track, with_odds(-3.0), 1 / fps)
        track = replace(track, log_odds=found.log_odds)
    assert found.log_odds == pytest.approx(-3.0 + 8.0 * 0.6**6, abs=1e-6)


def test_the_first_frame_of_a_track_is_believed_as_it_is() -> None:
    found = belief_of(memory=0.9).judge(followed(log_odds=None), with_odds(-3.0), FRAME_S)
    assert found.log_odds == pytest.approx(-3.0)


@pytest.mark.parametrize("fps", [60.0, 25.0, 15.0])
def test_a_bad_track_is_given_up_after_a_time(fps: float) -> None:
    belief, track, passed_s = belief_of(patience=5), followed(), 0.0
    while True:
        found = belief.judge(track, with_odds(-5.0), 1 / fps)
        assert found.lost
        if not found.kept:
            break
        passed_s += 1 / fps
        track = replace(track, bad_s=found.bad_s)
        assert passed_s < 1
    # Five frames of 1/25 s, the first of which has passed when it is seen; half a one is forgiven.
    assert 3.5 * FRAME_S < passed_s <= 3.5 * FRAME_S + 1 / fps


def test_a_good_frame_between_begins_the_time_anew() -> None:
    belief, track = belief_of(patience=2), followed()
    for log_odds in (-5.0, 5.0) * 4:
        found = belief.judge(track, with_odds(log_odds), FRAME_S)
        assert found.kept and (found.bad_s > 0) == (log_odds < 0)
        track = replace(track, bad_s=found.bad_s)


def test_a_doubtful_track_is_flagged_and_kept() -> None:
    belief, track = belief_of(patience=2, confidence=0.6, believe=0.6, give_up=0.3), followed()
    for _ in range(20):
        found = belief.judge(track, with_odds(0.0), FRAME_S)
        assert found.lost and found.kept
        track = replace(track, bad_s=found.bad_s)


def test_without_patience_no_track_is_given_up() -> None:
    belief, track = belief_of(patience=0), followed(bad_s=100.0)
    assert belief.judge(track, with_odds(-20.0), FRAME_S).kept


def test_the_state_s_name_says_why() -> None:
    def name(**changes: float) -> str:
        return belief_of().judge(followed(), with_odds(-5.0, **changes), FRAME_S).state_name

    assert belief_of().judge(followed(), GOOD, FRAME_S).state_name == "tracking"
    assert name() == "searching"
    assert name(unseen=0.8) == "out of view"
    assert name(hidden=0.8) == "hidden"


def palm_at(z: float = 0.5) -> torch.Tensor:
    state = torch.zeros(2, 27)
    state[:, 1:3] = torch.tensor([0.08, z])
    state[1, 3:6] = torch.tensor([0.0, 0.5, 0.0])
    return state


def features_of(
    joints: torch.Tensor, depth: torch.Tensor, score: float = 0.9
) -> ConfidenceFeatures:
    return confidence_features(joints, score, 1.0, detection_of(palm_at()), depth, K)


def test_signs_are_of_order_one_and_finite() -> None:
    joints = detection_of(palm_at()).joints_m[0]
    empty, wall = torch.zeros(144, 176), torch.full((144, 176), 0.9)
    for found in (joints, joints + 100.0, joints * 1e-6, joints * -1.0):
        for depth in (empty, wall):
            for score in (0.0, 1.0):
                values = features_of(found, depth, score).values()
                assert all(math.isfinite(value) and abs(value) < 15 for value in values)


def test_an_estimate_as_the_networks_see_it_has_good_signs() -> None:
    joints, wall = detection_of(palm_at()).joints_m[0], torch.full((144, 176), 0.9)
    right, wrong = features_of(joints, wall), features_of(joints + 0.1, wall)
    for name in ("keypoints_off", "farthest_keypoint_off", "pose_off", "likeliest_off"):
        assert getattr(right, name) < getattr(wrong, name) - 1
    assert right.unseen == right.hidden == 0 and right.absent < 0 and right.other_side < 0
    one = joints.clone()
    one[8] += 0.1
    assert features_of(one, wall).farthest_keypoint_off > right.farthest_keypoint_off + 1


def test_joints_out_of_sight_are_counted() -> None:
    joints = detection_of(palm_at()).joints_m[0]
    wall = torch.full((144, 176), 0.9)
    assert features_of(joints + torch.tensor([2.0, 0, 0]), wall).unseen == 1
    assert features_of(joints, torch.full((144, 176), 0.3)).hidden == 1
    half = wall.clone()
    u = (200.0 * joints[:, 0] / joints[:, 2] + 87.5).round()
    half[:, : int(u.median())] = 0.3
    assert 0.2 < features_of(joints, half).hidden < 0.8


def test_a_new_hand_must_convince_more_than_one_that_was_believed() -> None:
    belief, new = belief_of(confidence=0.2, believe=0.6), followed()
    old = replace(new, believed=True)
    assert belief.judge(new, with_odds(0.0), FRAME_S).lost
    assert not belief.judge(old, with_odds(0.0), FRAME_S).lost
