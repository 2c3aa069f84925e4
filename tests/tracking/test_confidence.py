"""How surely an estimate and its joints are right, and what follows for the estimate's track."""

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.detection import detection_of
from helpers.rendered import hand_at, track_of
from helpers.settings import confidence_model
from helpers.tracking import make_tracker, sample

from toftrack.compute.pace import FRAME_S, Duration
from toftrack.detector.detection import NO_DETECTION
from toftrack.errors import ToftrackError
from toftrack.frames.frame import DepthImage
from toftrack.refinement.gauss_newton import Keypoints
from toftrack.render.segmentation import Observation
from toftrack.tracking.association import track_ends
from toftrack.tracking.confidence import (
    COLUMNS,
    FEATURES,
    JOINT_FEATURES,
    KINDS,
    NO_FEATURES,
    ConfidenceFeatures,
    ConfidenceModel,
    JointConfidence,
    LogOdds,
    Status,
    confidence_features,
    joint_features,
    judge,
    probability,
)
from toftrack.tracking.paper import propagated_sigma
from toftrack.tracking.state import Track

K = np.array([[200.0, 0, 87.5], [0, 200.0, 71.5], [0, 0, 1]], np.float32)
WALL = np.full((144, 176), 0.9, np.float32)
JOINTS = confidence_model().joints
NO_JOINT_FEATURES = np.zeros((21, len(JOINT_FEATURES)))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"kinds": {"wrist": [0, 0, 0, 0]}}, "kinds must have a row for each of wrist, thumb_cmc"),
        ({"weights": dict.fromkeys(JOINT_FEATURES, [1, 2])}, "unsure must be 4 numbers: ray"),
        ({"kinds": dict.fromkeys(KINDS, [0, 0, 0, math.inf])}, "joints.kinds.wrist"),
    ],
)
def test_a_model_of_joints_that_cannot_be_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ToftrackError, match=words):
        replace(JOINTS, **changes)


def test_a_weight_of_an_unknown_feature_is_refused() -> None:
    with pytest.raises(ToftrackError, match="weights.luck is unknown; the features are log_"):
        LogOdds(0.0, {"luck": 1.0})


# A frame.


@pytest.mark.parametrize("name", FEATURES)
def test_log_odds_rise_and_fall_with_a_feature_as_its_weight_says(name: str) -> None:
    log_odds, more = LogOdds(4.0, {name: -0.7}), replace(NO_FEATURES, **{name: 1.0})
    assert log_odds(NO_FEATURES) == 4.0 and log_odds(more) == pytest.approx(3.3)


def palm_at(z: float = 0.5) -> torch.Tensor:
    state = hand_at(z=z).repeat(2, 1)
    state[1, 3:6] = torch.tensor([0.0, 0.5, 0.0])
    return state


PALM_M = detection_of(palm_at()).joints_m[0]


def features_of(
    joints: torch.Tensor, depth: np.ndarray = WALL, score: float = 0.9
) -> ConfidenceFeatures:
    z, none = torch.from_numpy(depth), torch.zeros(depth.shape, dtype=torch.bool)
    seen = Observation(z, none, none, torch.from_numpy(K), 0.5)
    return confidence_features(joints, score, followed(), detection_of(palm_at()), seen)


def test_features_are_of_order_one_and_finite() -> None:
    hands = PALM_M, PALM_M + 100.0, PALM_M * 1e-6, PALM_M * -1.0
    for found, depth, score in itertools.product(hands, (0 * WALL, WALL), (0.0, 1.0)):
        values = features_of(found, depth, score).values()
        assert all(math.isfinite(value) and abs(value) < 15 for value in values)


def test_an_estimate_as_the_networks_see_it_has_good_features_and_more_confidence() -> None:
    right, wrong = features_of(PALM_M), features_of(PALM_M + 0.1, score=0.1)
    for name in ("keypoints_off", "farthest_keypoint_off", "pose_off", "likeliest_off"):
        assert getattr(right, name) < getattr(wrong, name) - 1
    assert right.unseen == right.hidden == 0 and right.absent < 0.7 and right.other_side < 0.7
    one = PALM_M.clone()
    one[8] += 0.1
    assert features_of(one).farthest_keypoint_off > right.farthest_keypoint_off + 1
    model = confidence_model()
    assert model.log_odds(right) > model.log_odds(wrong)


def test_in_a_frame_without_a_detection_all_but_the_score_holds() -> None:
    last, none = features_of(PALM_M), torch.zeros(144, 176, dtype=torch.bool)
    seen = Observation(torch.from_numpy(WALL), none, none, torch.from_numpy(K), 0.5)
    found = confidence_features(PALM_M + 1.0, 0.5, followed(features=last), NO_DETECTION, seen)
    assert found == replace(last, log_score=math.log(0.5))


def test_joints_out_of_sight_are_counted() -> None:
    assert features_of(PALM_M + torch.tensor([2.0, 0, 0])).unseen == 1
    half = WALL.copy()
    half[:, : int((200.0 * PALM_M[:, 0] / PALM_M[:, 2] + 87.5).median())] = 0.3
    assert features_of(PALM_M, WALL / 3).hidden == 1 and 0.2 < features_of(PALM_M, half).hidden < 1


# What is thought of it.

PLAIN = replace(
    confidence_model(
        memory=0.0, believe=0.6, believe_frames=1, confidence=0.3, give_up=0.1, whole=0.0
    ),
    log_odds=LogOdds(0.0, {"log_score": 1.0}),
    whole_odds=LogOdds(0.0, {}),
)
"""Log odds are just the feature log_score."""


def followed(**changes: object) -> Track:
    return track_of(hand_at(), **changes)


def judged(
    track: Track,
    chance: float,
    dt_s: float = FRAME_S,
    model: ConfidenceModel = PLAIN,
    **features: float,
) -> Status:
    log_odds = math.log(chance / (1 - chance))
    return judge(track, replace(NO_FEATURES, log_score=log_odds, **features), dt_s, model)


@pytest.mark.parametrize(
    ("patience", "dt_s", "likely", "frames"),
    [
        (1, FRAME_S, None, 1),
        (5, FRAME_S, None, 5),
        (5, FRAME_S, 4, 10),  # one frame that is not doubtful begins the patience anew
        (0, FRAME_S, None, None),
        (5, FRAME_S / 2, None, 9),  # 1 + 8 halves
        (5, 0.5, None, 3),  # 1 + 2 + 2: what was dropped was not doubtful
    ],
)
def test_a_doubtful_track_ends_after_its_patience(
    patience: int, dt_s: float, likely: int | None, frames: int | None
) -> None:
    track, ends = followed(), []
    for frame in range(20):
        status = judged(track, 0.2 if frame == likely else 0.05, dt_s)
        track = replace(track, doubtful=status.doubtful)
        ends.append(track_ends(track, False, patience))
    assert (1 + ends.index(True) if any(ends) else None) == frames


@pytest.mark.parametrize(
    ("confirmed", "chance", "lost"),
    [(True, 0.31, False), (True, 0.29, True), (False, 0.59, True), (False, 0.61, False)],
)
def test_a_new_hand_is_asked_for_more_confidence_than_one_that_was_believed(
    confirmed: bool, chance: float, lost: bool
) -> None:
    status = judged(followed(confirmed=confirmed), chance)
    assert status.lost == lost and status.confidence == pytest.approx(chance)
    assert (status.state_name == "tracking") == (not lost)


@pytest.mark.parametrize(
    ("chances", "dt_s", "lost"),
    [
        ([0.5, 0.5, 0.5], FRAME_S, [True, True, False]),
        ([0.5, 0.5, 0.3, 0.5, 0.5, 0.5], FRAME_S, [True] * 5 + [False]),
        ([0.3, 0.7, 0.3], FRAME_S, [True, False, False]),  # believed at once, and from then on
        ([0.5] * 5, FRAME_S / 2, [True] * 4 + [False]),  # 1 + 4 halves
        ([0.5] * 3, 0.5, [True, True, False]),  # what was dropped was not likely
        ([0.3] * 9, FRAME_S, [True] * 9),
    ],
)
def test_a_new_hand_is_believed_where_it_is_sure_or_stays_likely(
    chances: list[float], dt_s: float, lost: list[bool]
) -> None:
    model = replace(PLAIN, believe=0.4, believe_frames=3, believe_at_once=0.6, confidence=0.2)
    track, found = followed(confirmed=False), []
    for chance in chances:
        status = judged(track, chance, dt_s, model)
        found.append(status.lost)
        track = replace(track, likely=status.likely, confirmed=track.confirmed or not status.lost)
    assert found == lost


def test_a_hand_that_is_wrong_as_a_whole_is_flagged_however_sure_its_joints_are() -> None:
    model = replace(PLAIN, whole=0.5, whole_odds=LogOdds(3.0, {"other_side": -2.0}))
    for other_side, lost in ((0.0, False), (1.4, False), (1.6, True)):
        found = judged(followed(), 0.98, model=model, other_side=other_side)
        assert found.lost == lost and found.whole_odds == pytest.approx(3.0 - 2.0 * other_side)


@pytest.mark.parametrize(
    ("features", "name"),
    [
        ({"unseen": 0.1, "hidden": 0.1}, "searching"),
        ({"hidden": 0.5}, "hidden"),
        ({"unseen": 0.5, "hidden": 0.5}, "out of view"),
    ],
)
def test_a_lost_estimate_says_why(features: dict[str, float], name: str) -> None:
    assert judged(followed(), 0.05, **features).state_name == name


def test_the_log_odds_are_smoothed_over_time_but_in_a_first_frame() -> None:
    model, features = replace(PLAIN, memory=0.5), replace(NO_FEATURES, log_score=2.0)
    older, new = followed(log_odds=-2.0), followed(age=Duration(), log_odds=-2.0)
    cases = ((older, FRAME_S), (older, 2 * FRAME_S), (new, FRAME_S))
    found = [judge(track, features, dt_s, model).log_odds for track, dt_s in cases]
    assert found == pytest.approx([0.0, 1.0, 2.0])
    whole = judge(followed(log_odds=5.0, whole_odds=-4.0), features, FRAME_S, model).whole_odds
    assert whole == pytest.approx(-2.0)


def test_probabilities_are_those_of_the_log_odds_and_finite() -> None:
    assert probability(-2.0) == pytest.approx(1 / (1 + math.exp(2.0)))
    assert 0 <= probability(-1e9) < 1e-9 and 1 >= probability(1e9) > 1 - 1e-9


# Its joints.


def joints_at(z: float = 0.5) -> np.ndarray:
    """(21, 3) joints apart from each other."""
    column, row = np.meshgrid(np.arange(7), np.arange(3))
    flat = np.stack((column.ravel() - 3.0, row.ravel() - 1.0, np.zeros(21)), 1)
    return (0.03 * flat + (0, 0, z)).astype(np.float32)


def joint_features_of(
    joints: np.ndarray, depth: np.ndarray = WALL, **changes: Any
) -> dict[str, np.ndarray]:
    """Features by name; as a rule the networks see the joints where they are."""
    keypoints = Keypoints(torch.from_numpy(joints_at()), torch.full((21,), 0.005))
    detection = replace(detection_of(torch.zeros(1, 27)), keypoints=keypoints)
    usual = {"detection": detection, "last": NO_JOINT_FEATURES, "score": 0.9, "log_odds": 2.0}
    found = joint_features(joints, image=DepthImage(depth, K, 0, 0.0), **(usual | changes))
    return dict(zip(JOINT_FEATURES, found.T, strict=True))


def believed(features: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Deviations and probabilities by the package's model."""
    return JOINTS.judge(np.stack(list(features.values()), 1))


@pytest.mark.parametrize("name", JOINT_FEATURES)
def test_the_package_s_confidence_is_never_surer_for_a_feature_against_a_joint(name: str) -> None:
    worse = NO_JOINT_FEATURES.copy()
    worse[:, JOINT_FEATURES.index(name)] += 1
    (sigma, near), (wider, less) = JOINTS.judge(NO_JOINT_FEATURES), JOINTS.judge(worse)
    assert (wider >= sigma).all() and (less <= near).all()
    assert (wider > sigma).any() or (less < near).any()


def test_a_row_of_weights_is_of_its_column_and_kind() -> None:
    nothing = [0.0] * len(COLUMNS)
    kinds = dict.fromkeys(KINDS, nothing) | {"tip": [math.log(2), 0, 0, 1.5]}
    weights = dict.fromkeys(JOINT_FEATURES, nothing) | {"doubt": [0, 0.5, 0, -1.0]}
    features = NO_JOINT_FEATURES.copy()
    features[3, JOINT_FEATURES.index("doubt")] = 2.0
    sigma, near = JointConfidence(kinds, weights).judge(features)
    expected = np.full((21, 3), 0.01)
    expected[[8, 12, 16, 20], 0] = 0.02
    expected[3, 1] = 0.01 * math.e
    np.testing.assert_allclose(sigma, expected, rtol=1e-5)
    odds = np.log(near / (1 - near))
    assert odds[[0, 3, 8]] == pytest.approx([0, -2, 1.5], abs=1e-5)


def test_features_of_joints_and_what_follows_are_finite_whatever_is_seen() -> None:
    hands = joints_at(), joints_at() + 100, joints_at() * 1e-6, -joints_at()
    for joints, depth, score in itertools.product(hands, (WALL, 0 * WALL), (0.0, 1.0)):
        odds = 2e3 * score - 1e3
        found = joint_features_of(joints.astype(np.float32), depth, score=score, log_odds=odds)
        sigma, near = believed(found)
        assert np.isfinite(sigma).all() and (sigma > 0).all()
        assert ((near >= 0) & (near <= 1)).all()


def test_a_joint_away_from_its_keypoint_speaks_against_its_finger() -> None:
    moved = joints_at()
    moved[6] += (0, 0, 0.05)
    before, after = joint_features_of(joints_at()), joint_features_of(moved)
    changed = after["keypoint_off"] > before["keypoint_off"] + 1
    assert np.flatnonzero(changed).tolist() == [6]
    # The wrist stands for the whole hand.
    farther = after["finger_off"] > before["finger_off"] + 1
    assert np.flatnonzero(farther[1:]).tolist() == [4, 5, 6, 7]
    assert after["finger_off"][0] > before["finger_off"][0]


def test_a_hidden_joint_says_so() -> None:
    row = np.where(np.arange(176) < 60, 0.4, 0.497).astype(np.float32)
    open_, half = np.full_like(WALL, 0.497), np.tile(row, (144, 1))
    before, after = joint_features_of(joints_at(), open_), joint_features_of(joints_at(), half)
    behind = 200 * joints_at()[:, 0] / 0.5 + 87.5 < 57
    assert 0 < behind.sum() < 21
    assert (before["behind"] == 0).all() and (before["before"] < 0.6).all()
    assert (after["behind"][behind] > 2).all() and (after["behind"][~behind] == 0).all()
    assert (joint_features_of(joints_at())["before"] > 2).all()
    (sigma, near), (wider, less) = believed(before), believed(after)
    assert (wider[behind] > sigma[behind]).all() and (wider[~behind] == sigma[~behind]).all()
    # Nor any less near for that alone; it is no longer in front of what is seen.
    assert np.abs(less - near).max() < 0.002 and (less[~behind] == near[~behind]).all()


def test_what_is_out_of_the_image_or_not_read_is_distinguished() -> None:
    away = joint_features_of(joints_at() + np.array([1, 0, 0], np.float32))
    blank = joint_features_of(joints_at(), 0 * WALL)
    assert (away["outside"] == 1).all() and (away["unread"] == 0).all()
    assert (blank["unread"] == 1).all() and (blank["outside"] == 0).all()
    assert (blank["behind"] == 0).all() and (blank["before"] == 0).all()


def test_without_a_detection_the_last_keypoints_hold_and_the_image_is_read_anew() -> None:
    last = np.stack(list(joint_features_of(joints_at(0.6)).values()), 1)
    found = joint_features_of(joints_at(), 0 * WALL, detection=NO_DETECTION, last=last)
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
    assert estimate.joint_sigma_m.shape == (21, 3) and estimate.joint_ok.shape == (21,)
    assert estimate.joint_sigma_m.dtype == estimate.joint_confidence.dtype == np.float32
    assert ((estimate.joint_sigma_m > 5e-4) & (estimate.joint_sigma_m < 0.1)).all()
    paper = "experiment=paper" in overrides
    least = 0.0 if paper else tracker.model.lost.joint_ok
    assert not estimate.lost and estimate.joint_ok.any()
    assert (estimate.joint_ok == ~(estimate.joint_confidence < least)).all()
    assert (np.isfinite(estimate.joint_confidence) != paper).all()
    gone = tracker.step(np.zeros_like(depth), scene.k, 3, 3 / 25)
    assert np.isnan(gone.joint_sigma_m).all() and (gone.joint_confidence == 0).all()
    assert gone.joint_ok.dtype == bool and not gone.joint_ok.any()
