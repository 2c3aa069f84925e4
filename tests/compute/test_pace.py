"""The time from one frame to the next."""

import pytest

from toftrack.compute.pace import FRAME_S, elapsed_s


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
