"""A run with a device that does not wait: what was dropped is told, and is no loss of the hand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.tracking import run

from toftrack.devices.base import BaseDevice
from toftrack.devices.replay import Sample
from toftrack.files.json_text import read_json
from toftrack.frames.frame import Frame

pytestmark = pytest.mark.usefixtures("one_thread")

OVERRIDES = ("hand.side=right", "view=none")
FEW = 4


class Late(BaseDevice):
    """The sample as a camera; of every so many frames one is delivered."""

    def __init__(self, every: int, live: bool) -> None:
        self._sample = Sample(stop=FEW * every)
        super().__init__(self._sample.camera, 25.0, live=live)
        self._every = every

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._sample:
            if frame.index % self._every == 0:
                self.dropped = frame.index // self._every * (self._every - 1)
                yield frame


def test_a_run_that_was_too_slow_says_so(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    run(tmp_path, Late(every=5, live=True), *OVERRIDES)
    out, err = capsys.readouterr()
    reported = read_json(tmp_path / "summary.json")
    assert reported["realtime"]["dropped_frames"] == reported["dropped_frames"] == 12
    assert reported["realtime"]["tracked_frames"] == FEW
    assert reported["realtime"]["longest_gap_s"] == pytest.approx(0.2)
    (note,) = (line for line in err.splitlines() if line.startswith("note: "))
    assert "12 of 16 frames were dropped: the machine was too slow for 25" in note
    assert "16, 0 of them lost, 12 dropped" in out


def test_of_a_recording_nothing_of_that_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    run(tmp_path, Late(every=5, live=False), *OVERRIDES, "tracker.budget_ms=0.001")
    assert "realtime" not in read_json(tmp_path / "summary.json")
    assert "too slow" not in capsys.readouterr().err
