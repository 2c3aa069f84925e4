"""The One Euro filter on estimates: calm at rest, quick in motion, anew after the hand was lost."""

import math
from dataclasses import replace

import numpy as np
import pytest
import roma
import torch
from helpers.settings import part

from toftrack.errors import ToftrackError
from toftrack.frames.estimate import Estimate, no_estimate
from toftrack.gestures.recognition import pointing_ray
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.output.smoothing import OneEuro, SmoothState, smooth

SHAPE = default_hand_shape()
REST = np.concatenate(([0.02, -0.05, 0.5], [0.3, -0.2, 1.0], np.full(21, 0.2)))


DEFAULT: OneEuro = part("smooth=one_euro", "smooth")


def estimate(state: np.ndarray, time_s: float = 0.0, name: str = "tracking") -> Estimate:
    state = np.asarray(state, np.float32)
    joints = forward_kinematics(torch.from_numpy(state)[None], SHAPE).joints_m[0].numpy()
    empty = no_estimate(round(25 * time_s), time_s, name, 4, 0.0)
    lost = name in ("lost", "recovering")
    return replace(empty, state=state, joints_m=joints, score=0.9, lost=lost)


def filtered(estimates: list[Estimate], cfg: OneEuro | None = DEFAULT) -> list[Estimate]:
    state: SmoothState | None = None
    found = []
    for one in estimates:
        state, calm = smooth(cfg, state, one, SHAPE)
        found.append(calm)
    return found


def joints(estimates: list[Estimate]) -> np.ndarray:
    return np.stack([one.joints_m for one in estimates])


def trembling(frames: int = 75) -> list[Estimate]:
    noise = np.random.default_rng(0).normal(size=(frames, 27)) * ([0.001] * 3 + [0.01] * 24)
    return [estimate(REST + noise[i], i / 25) for i in range(frames)]


def moving(velocity: np.ndarray, frames: int = 50, hz: float = 25) -> list[Estimate]:
    return [estimate(REST + velocity * i / hz, i / hz) for i in range(frames)]


def along(axis: int, speed: float) -> np.ndarray:
    velocity = np.zeros(27)
    velocity[axis] = speed
    return velocity


def test_a_hand_at_rest_trembles_less_than_half_as_much() -> None:
    raw = trembling()
    steps = [
        np.linalg.norm(np.diff(joints(x)[25:], axis=0), axis=-1).mean()
        for x in (raw, filtered(raw))
    ]
    assert steps[1] < 0.5 * steps[0]


@pytest.mark.parametrize(("axis", "speed"), [(0, 0.5), (2, -0.2), (4, 3.0), (12, 4.0)])
def test_in_motion_it_lags_less_than_a_frame(axis: int, speed: float) -> None:
    found = filtered(moving(along(axis, speed), 20))
    if axis < 3 or axis > 5:
        behind = (REST[axis] + speed * 19 / 25 - found[-1].state[axis]) / speed
    else:  # rotation vectors do not add up
        now, last = (moving(along(axis, speed), 20)[k].joints_m for k in (-1, -2))
        behind = np.linalg.norm(found[-1].joints_m - now) / np.linalg.norm(last - now) / 25
    assert 0 < behind < 0.02


def test_without_speed_it_is_the_low_pass_of_its_cut_off() -> None:
    """A step, by hand: share = 1 / (1 + 1 / (2 pi f dt))."""
    cfg = OneEuro(2.0, 0.0, 0.0, 0.0, 1.0, False)
    step = REST + along(0, 0.1)
    found = filtered([estimate(REST, 0.0), estimate(step, 0.04), estimate(step, 0.08)], cfg)
    share = 1 / (1 + 1 / (2 * math.pi * 2.0 * 0.04))
    moved = [one.state[0] - REST[0] for one in found]
    assert moved == pytest.approx([0, 0.1 * share, 0.1 * (1 - (1 - share) ** 2)], abs=1e-6)


def test_the_time_stamps_decide_and_not_the_number_of_frames() -> None:
    """Half of the frames dropped: the hand is nearly where it would have been."""
    raw = moving(along(1, 0.3), 60, hz=50)
    every = filtered(raw)
    some = filtered([raw[i] for i in range(60) if i % 2 == 1 or i < 2])
    assert np.abs(some[-1].joints_m - every[-1].joints_m).max() < 0.002
    late = filtered([raw[0], replace(raw[1], timestamp_s=60.0)])
    assert np.abs(late[-1].joints_m - raw[1].joints_m).max() < 1e-4, "after a minute it is history"


def test_joints_state_and_pointing_agree_and_bones_keep_their_lengths() -> None:
    raw = []
    for one in trembling(10):
        origin, direction = pointing_ray(one.joints_m)
        raw.append(replace(one, pointing_origin_m=origin, pointing_direction=direction))
    for before, after in zip(raw[1:], filtered(raw)[1:], strict=True):
        assert not np.array_equal(before.state, after.state)
        assert np.allclose(after.joints_m, estimate(after.state).joints_m, atol=1e-6)
        assert np.allclose(pointing_ray(after.joints_m)[0], after.pointing_origin_m)
        assert np.allclose(pointing_ray(after.joints_m)[1], after.pointing_direction)
        assert after.joints_m.dtype == after.state.dtype == np.float32
        for name in ("covariance", "latent", "score", "gesture", "index", "timestamp_s", "lost"):
            assert getattr(after, name) is getattr(before, name), name


def test_a_turn_past_half_a_circle_goes_the_short_way() -> None:
    """The rotation vector jumps to the other side of the sphere there; the hand does not."""
    raw = []
    for i in range(30):
        vector = torch.tensor([0.0, 0.0, math.pi - 0.3 + 0.02 * i], dtype=torch.float64)
        wrapped = roma.rotmat_to_rotvec(roma.rotvec_to_rotmat(vector)).numpy()
        raw.append(estimate(np.concatenate((REST[:3], wrapped, REST[6:])), i / 25))
    assert raw[0].state[5] > 0 > raw[-1].state[5], "the vectors are on both sides"
    away = np.linalg.norm(joints(filtered(raw)) - joints(raw), axis=-1)
    assert away.max() < 0.02


@pytest.mark.parametrize("name", ["lost", "recovering", "initialising"])
def test_what_was_before_a_loss_does_not_pull_at_what_comes_after(name: str) -> None:
    far = REST + along(0, 0.2)
    between = estimate(far if name == "initialising" else REST, 0.2, name)
    raw = [*moving(along(0, 0), 5), between, estimate(far, 0.24)]
    found = filtered(raw)
    assert found[5] is raw[5]
    assert np.allclose(found[6].joints_m, raw[6].joints_m, atol=1e-6)


def test_time_that_stands_still_or_goes_back_starts_anew() -> None:
    for time_s in (0.04, 0.0):
        raw = [estimate(REST), estimate(REST, 0.04), estimate(REST + 0.1, time_s)]
        assert filtered(raw)[-1] is raw[-1]


def test_without_a_filter_everything_passes() -> None:
    raw = trembling(3)
    assert all(a is b for a, b in zip(raw, filtered(raw, None), strict=True))
    assert part("smooth=none", "smooth") is None


@pytest.mark.parametrize(
    ("name", "value"), [("min_cutoff_hz", 0), ("angle_beta", -1), ("rotation_beta", math.nan)]
)
def test_a_setting_out_of_range_is_one_clear_error(name: str, value: float) -> None:
    with pytest.raises(ToftrackError, match=name):
        replace(DEFAULT, **{name: value})
