"""A run with a device that does not wait: what was dropped is told, and is no loss of the hand."""

import re
from pathlib import Path

import pytest
from helpers.tracking import Camera, run

from toftrack.files.json_text import read_json
from toftrack.output.results import RealTime

pytestmark = pytest.mark.usefixtures("one_thread")

OVERRIDES = ("hand.side=right", "view=none")


def test_a_run_that_was_too_slow_says_so(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    run(tmp_path, Camera(4, every=5), *OVERRIDES)
    out, err = capsys.readouterr()
    reported = read_json(tmp_path / "summary.json")
    assert reported["realtime"]["dropped_frames"] == reported["dropped_frames"] == 12
    assert reported["realtime"]["tracked_frames"] == 4
    assert reported["realtime"]["longest_gap_s"] == pytest.approx(0.2)
    (note,) = (line for line in err.splitlines() if line.startswith("note: "))
    assert "12 of 16 frames were dropped" in note
    assert "16, 0 of them lost, 12 dropped" in out


@pytest.mark.parametrize(
    ("took_s", "words"),
    [
        (0.1, ": the machine was too slow for 25 frames/s, as "),
        (0.02, ", although .* 20 ms on average, which suffices .* pauses of up to 2.0 s"),
    ],
)
def test_a_machine_that_was_fast_enough_is_not_called_slow(took_s: float, words: str) -> None:
    pace = RealTime(25.0)
    pace.add(5.0, took_s, 0, 0)
    pace.add(7.0, took_s, 0, 49)
    assert re.match(f"49 of 51 frames were dropped{words}", pace.words())


def test_of_a_recording_nothing_of_that_is_said(tmp_path, capsys) -> None:
    run(tmp_path, Camera(4, every=5, live=False), *OVERRIDES, "tracker.budget_ms=0.001")
    assert "realtime" not in read_json(tmp_path / "summary.json")
    assert "too slow" not in capsys.readouterr().err
