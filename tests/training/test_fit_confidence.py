"""The fit of the confidence: on errors that are made up, so that what is right is known."""

from argparse import Namespace

import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.hand.regions import REGION_90
from toftrack.tracking.confidence import FEATURES, JOINT_FEATURES
from toftrack.training import fit_confidence
from toftrack.training.fit_confidence import Observed, fitted_joint_belief, with_doubt

FRAMES = 600
UNSURE, DOUBT = JOINT_FEATURES.index("unsure"), JOINT_FEATURES.index("doubt")


@pytest.fixture(scope="module")
def rows() -> Observed:
    """Errors that grow with one sign, three times as large along the ray as else; long tails."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(FRAMES, 21, len(JOINT_FEATURES)))
    tails = np.sqrt(4 / rng.chisquare(4, (FRAMES, 21, 1)))
    size = np.exp(0.7 * features[..., UNSURE : UNSURE + 1]) * [1.5, 0.5, 0.5]
    error = rng.normal(size=(FRAMES, 21, 3)) * tails * size
    near = rng.random((FRAMES, 21)) < 1 / (1 + np.exp(2 * features[..., DOUBT]))
    yes = np.ones(FRAMES, bool)
    return Observed(np.zeros((FRAMES, len(FEATURES))), yes, yes, features, error, near, yes, yes)


def test_the_fit_finds_what_made_the_errors(rows: Observed) -> None:
    belief = fitted_joint_belief(rows)
    assert belief.weights["unsure"][:3] == pytest.approx([0.7] * 3, abs=0.08)
    others = [belief.weights[name][:3] for name in JOINT_FEATURES if name != "unsure"]
    assert np.abs(others).max() < 0.1
    assert belief.weights["doubt"][3] == pytest.approx(-2, abs=0.3)
    ray, along, across, _ = belief.kinds["pip"]
    assert ray - along == pytest.approx(np.log(3), abs=0.15)
    assert along == pytest.approx(across, abs=0.15)


def test_regions_hold_nine_of_ten_whatever_the_sign(rows: Observed) -> None:
    belief = fitted_joint_belief(rows)
    sigma = 100 * np.stack([belief.judge(features)[0] for features in rows.joint_features])
    inside = np.sqrt(np.square(rows.error_cm / sigma).sum(2)) <= REGION_90
    for part in (rows.joint_features[..., UNSURE] < -0.5, rows.joint_features[..., UNSURE] > 0.5):
        assert inside[part].mean() == pytest.approx(0.9, abs=0.02)


def test_frames_that_do_not_count_change_no_standard_deviation(rows: Observed) -> None:
    counted = np.arange(FRAMES) < 500
    wrong = rows.error_cm.copy()
    wrong[~counted] *= 100
    some = rows._replace(counted=counted)
    one, two = fitted_joint_belief(some), fitted_joint_belief(some._replace(error_cm=wrong))
    assert [row[:3] for row in one.kinds.values()] == [row[:3] for row in two.kinds.values()]


def test_doubt_of_joints_follows_the_new_log_odds_within_each_track() -> None:
    count = 6
    features = np.zeros((count, len(FEATURES)))
    features[[0, 4], FEATURES.index("young")] = 1  # tracks that begin
    yes, ones = np.ones(count, bool), np.ones((count, 21, len(JOINT_FEATURES)))
    seen = Observed(features, yes, yes, ones, ones, ones, yes, np.array([0, 0, 1, 1, 1, 1]))
    log_odds = np.array([2.0, -2.0, 4.0, 0.0, -4.0, 4.0])
    found = with_doubt(seen, log_odds, memory=0.75).joint_features
    smooth = -np.log(np.expm1(found[:, 0, DOUBT]))
    assert smooth == pytest.approx([2.0, 1.0, 4.0, 3.0, -4.0, -2.0])
    assert (np.delete(found, DOUBT, 2) == 1).all()
    assert (ones == 1).all()


def test_too_few_sequences_are_one_sentence(tmp_path, monkeypatch) -> None:
    for name in ("random_sequence", "observed"):
        monkeypatch.setattr(fit_confidence, name, lambda *_: None)
    asked = Namespace(overrides=[], seed=1, sequences=1, frames=1, output=tmp_path)
    with pytest.raises(ToftrackError, match="--sequences"):
        fit_confidence.fit_confidence(asked)
