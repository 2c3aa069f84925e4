"""Time between frames: settings count frames of 25 a second, whatever the camera's rate."""

from __future__ import annotations

import pytest

from toftrack.compute.pace import FRAME_S, Duration, elapsed_s


def after(frames: int, dt_s: float, **most: float) -> Duration:
    """A duration of so many frames, each dt_s after the one before."""
    duration = Duration()
    for _ in range(frames):
        duration = duration.extended(dt_s, **most)
    return duration


@pytest.mark.parametrize("dt_s", [1 / 120, 1 / 60, FRAME_S, 1 / 15, 0.5])
def test_a_single_frame_counts_alike_at_any_rate(dt_s: float) -> None:
    once = after(1, dt_s)
    assert once.begun and once.reached(1) and not once.reached(2)
    assert once.seconds == FRAME_S


@pytest.mark.parametrize("frames", [1, 2, 3, 5, 50])
def test_at_25_frames_a_second_settings_count_frames(frames: int) -> None:
    assert after(frames, FRAME_S).reached(frames)
    assert not after(frames, FRAME_S).reached(frames + 1)


@pytest.mark.parametrize("rate", [15, 30, 50, 60, 100])
@pytest.mark.parametrize("frames", [3, 5, 10])
def test_at_other_rates_the_same_time_passes(rate: int, frames: int) -> None:
    counts = (n for n in range(1, 1000) if after(n, 1 / rate).reached(frames))
    passed_s = (next(counts) - 1) / rate  # from the first frame to the one in which it is reached
    assert abs(passed_s - (frames - 1) * FRAME_S) <= 0.5 * FRAME_S + 1 / rate


def test_of_a_pause_no_more_counts_than_is_said() -> None:
    assert after(2, 0.5, most_s=2 * FRAME_S).seconds == pytest.approx(3 * FRAME_S)
    assert after(2, 0.01, most_s=2 * FRAME_S).seconds == pytest.approx(FRAME_S + 0.01)
    assert after(2, 0.5).seconds == pytest.approx(FRAME_S + 0.5)


@pytest.mark.parametrize(
    ("before_s", "now_s", "expected_s"),
    [
        (None, 7.0, FRAME_S),
        (1.0, 1.02, 0.02),
        (1.0, 0.0, FRAME_S),
        (1.0, 1.0, 1 / 120),
        (1.0, 100.0, 0.5),
    ],
    ids=["first", "usual", "back", "coarse", "pause"],
)
def test_the_time_from_frame_to_frame_is_one_to_reckon_with(
    before_s: float | None, now_s: float, expected_s: float
) -> None:
    assert elapsed_s(before_s, now_s) == pytest.approx(expected_s)
