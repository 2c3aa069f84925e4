"""A gesture of the user's from frames that show it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.gestures.files import learned_pose

STEADY = math.radians(25)
POSE = np.linspace(0.0, 1.5, 21)


def shown(frames: int = 20, tremor: float = 0.03) -> np.ndarray:
    return POSE + np.random.default_rng(0).normal(0, tremor, (frames, 21))


def test_the_pose_is_the_middle_of_the_frames_and_its_spread_their_tremor() -> None:
    pose = learned_pose("mine", shown(200), np.ones(200, bool), STEADY)
    assert pose.name == "mine"
    assert pose.angles_rad == pytest.approx(POSE, abs=0.01)
    assert pose.spread_rad == pytest.approx(np.full(21, 0.03), rel=0.4)


def test_wrong_and_disbelieved_frames_do_no_harm() -> None:
    angles, believed = shown(), np.ones(20, bool)
    angles[:3, 6:9] += 1.5
    angles[3:8], believed[3:8] = math.nan, False
    pose = learned_pose("mine", angles, believed, STEADY)
    assert pose.angles_rad == pytest.approx(POSE, abs=0.06)


@pytest.mark.parametrize(("frames", "believed"), [(20, 9), (4, 4)])
def test_a_hand_that_was_hardly_followed_is_refused(frames: int, believed: int) -> None:
    with pytest.raises(ToftrackError, match=f"in only {believed} of the {frames} frames"):
        learned_pose("mine", shown(frames), np.arange(frames) < believed, STEADY)


def test_a_hand_that_moves_its_fingers_is_refused() -> None:
    angles = shown()
    angles[:, 14] += np.linspace(0, 2, 20)
    with pytest.raises(ToftrackError, match="the ring finger bends and stretches"):
        learned_pose("mine", angles, np.ones(20, bool), STEADY)
