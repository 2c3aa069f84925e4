"""The fit of the belief: what comes from frames is passed on to their joints."""

from __future__ import annotations

import numpy as np
import pytest

from toftrack.tracking.confidence import FEATURES, JOINT_FEATURES
from toftrack.training.fit_confidence import Observed, with_doubt
from toftrack.training.joint_fit import JointRows


def test_doubt_of_joints_follows_the_new_log_odds_within_each_track() -> None:
    count = 6
    features = np.zeros((count, len(FEATURES)))
    features[[0, 4], FEATURES.index("young")] = 1  # tracks that begin
    joints = JointRows(
        np.ones((count, 21, len(JOINT_FEATURES))),
        np.zeros((count, 21, 3)),
        np.ones((count, 21), bool),
        np.ones(count, bool),
    )
    right = np.ones(count, bool)
    seen = Observed(features, right, right, joints, np.array([0, 0, 1, 1, 1, 1]))
    log_odds = np.array([2.0, -2.0, 4.0, 0.0, -4.0, 4.0])
    found = with_doubt(seen, log_odds, memory=0.75).joints.features
    doubt = JOINT_FEATURES.index("doubt")
    smooth = -np.log(np.expm1(found[:, 0, doubt]))
    assert smooth == pytest.approx([2.0, 1.0, 4.0, 3.0, -4.0, -2.0])
    assert (np.delete(found, doubt, 2) == 1).all()
    assert (joints.features == 1).all()
