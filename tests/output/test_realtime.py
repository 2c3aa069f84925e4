"""What is said of a live run that could not keep up."""

from __future__ import annotations

import pytest

from toftrack.output.realtime import RealTime


def kept_up(tracked: int, dropped: int, reduced: int = 0) -> RealTime:
    """A second frame for each that was tracked, the last one after a pause."""
    facts = RealTime(30.0)
    for number in range(tracked):
        time_s = number / 15 + (0.5 if number == tracked - 1 else 0.0)
        facts = facts.after(time_s, 0.055, reduced, dropped)
    return facts


def test_dropped_frames_are_reported_with_what_to_do() -> None:
    words = kept_up(20, 80, reduced=18).words()
    assert words.startswith(
        "80 of 100 frames were dropped: the machine was too slow for 30 frames/s, a frame took 55 "
        "ms (20 were tracked, 18 of them with reduced effort). "
    )
    assert "view=none" in words


def test_a_few_dropped_frames_are_not_worth_a_word() -> None:
    facts = kept_up(98, 2)
    assert facts.words() == "" and not facts.too_slow
    assert "note" not in facts.summary()


def test_the_summary_has_the_longest_gap() -> None:
    said = kept_up(20, 80, reduced=18).summary()
    assert said["longest_gap_s"] == pytest.approx(1 / 15 + 0.5)
    assert (said["tracked_frames"], said["dropped_frames"], said["reduced_frames"]) == (20, 80, 18)
    assert said["note"].startswith("80 of 100")
