"""Pinch: how nearly thumb and index finger touch, and one event a pinch."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.settings import part

from toftrack.errors import ToftrackError
from toftrack.gestures.pinch import PinchSettings, PinchState, pinch_of, update_pinch
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import forward_kinematics

SETTINGS: PinchSettings = part("gestures=default", "gestures.pinch")
PINCHED = (3, 20, -28, 19, 23, -8, 26, 71, 30)
"""Degrees of the thumb's and the index finger's joints, the tips together."""


def joints(open_part: float, length_m: float = 0.19) -> np.ndarray:
    """(21, 3) of a hand between a pinch, 0, and straight fingers, 1."""
    state = torch.zeros(1, 27)
    state[0, :6] = torch.tensor([0.1, 0.0, 0.5, 0.3, 1.0, -0.4])
    state[0, 6:15] = torch.tensor(PINCHED).deg2rad() * (1 - open_part)
    return forward_kinematics(state, default_hand_shape(length_m)).joints_m[0].numpy()


def follow(values: list[float], frames: float = 1.0) -> list[bool]:
    state, reported = PinchState(), []
    for value in values:
        state = update_pinch(state, value, SETTINGS, frames)
        reported.append(state.pinching)
    return reported


def test_a_pinch_goes_from_1_to_0_as_the_fingers_open() -> None:
    pinches = [pinch_of(joints(part), SETTINGS) for part in np.linspace(0, 1, 11)]
    assert pinches[0] == 1.0 and pinches[-1] == 0.0
    assert all(a >= b for a, b in zip(pinches, pinches[1:], strict=False))
    assert any(0.2 < pinch < 0.8 for pinch in pinches)


def test_a_tip_that_is_not_ok_begins_no_pinch_and_ends_one() -> None:
    ok = np.ones(21, bool)
    ok[20] = False
    assert pinch_of(joints(0.0), SETTINGS, ok) == 1.0, "the little finger does not matter"
    ok[8] = False
    unknown = pinch_of(joints(0.0), SETTINGS, ok)
    assert np.isnan(unknown)
    assert not any(follow([unknown] * 9))
    assert follow([1.0] * 5 + [unknown, 1.0])[-3:] == [True] * 3, "a short doubt passes"
    assert follow([1.0] * 5 + [unknown] * 5)[-1] is False


def test_a_small_hand_pinches_as_a_large_one() -> None:
    for opened in np.linspace(0, 1, 11):
        small, large = (pinch_of(joints(opened, length_m), SETTINGS) for length_m in (0.14, 0.21))
        assert small == pytest.approx(large, abs=1e-3)


def test_a_pinch_that_trembles_about_a_threshold_begins_and_ends_once() -> None:
    rng = np.random.default_rng(0)
    way = np.concatenate((np.linspace(0, 1, 60), np.linspace(1, 0, 60)))
    reported = follow((way + rng.normal(0, 0.06, 120)).clip(0, 1).tolist())
    assert sum(a != b for a, b in zip(reported, reported[1:], strict=False)) == 2
    assert not reported[0] and reported[60] and not reported[-1]


def test_one_odd_frame_is_no_pinch_and_ends_none() -> None:
    assert not any(follow([0.0] * 3 + [1.0] + [0.0] * 3))
    assert all(follow([1.0] * 4 + [0.0] + [1.0] * 3)[2:])
    # At a low frame rate a frame lasts as long as that.
    assert follow([0.0, 1.0, 0.0], frames=4.0) == [False, True, False]


@pytest.mark.parametrize(
    "bad", [{"touching": 0.5}, {"begin": 1.2}, {"end": 0.9}, {"frames": -1.0}], ids=str
)
def test_settings_out_of_range_are_reported(bad: dict[str, float]) -> None:
    with pytest.raises(ToftrackError, match="gestures.pinch"):
        dataclasses.replace(SETTINGS, **bad)


def test_fingers_that_touch_in_every_other_frame_do_not_pinch() -> None:
    assert not any(follow([1.0, 0.0] * 9))
