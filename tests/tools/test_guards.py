"""What the guards say, and what they cannot see."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.tracking import ROOT, configuration

from toftrack.hand.shape import default_hand_shape
from toftrack.recordings.store import open_recording

sys.path.insert(0, str(Path(__file__).parent))
from breaks import BREAKS
from guards import BOUNDS, SAMPLE_MM, complaints, recordings

GOOD = {"seed": 0.0, **{name: (low + high) / 2 for name, (low, high) in BOUNDS.items()}}
SAMPLE = {"seed": 0.0, "sample_mm": SAMPLE_MM - 0.5, "sample_lost_pct": 0.0}


def test_each_figure_has_a_bound_that_can_be_left() -> None:
    assert complaints([GOOD, GOOD], [SAMPLE]) == []
    for name, (low, high) in BOUNDS.items():
        assert (low, high) != (0, 100)
        for wrong in (low - 1, high + 1, np.nan):
            said = complaints([GOOD | {name: wrong}] * 3, [SAMPLE])
            assert len(said) == 1 and name in said[0]
    assert "mean joint error" in complaints([GOOD], [SAMPLE | {"sample_mm": SAMPLE_MM + 1}])[0]
    assert "are lost" in complaints([GOOD], [SAMPLE | {"sample_lost_pct": 1.0}])[0]


def test_the_recordings_are_those_that_the_scripts_make() -> None:
    tracked, without = recordings("guards"), recordings("empty")
    assert len(tracked) == 8 and len(without) == 10
    for recording in (*tracked.values(), *without.values()):
        assert len(recording) == 40 and recording.truth is not None
    assert not any(recording.truth.visible.any() for recording in without.values())
    resting = tracked["still_face"].truth
    assert resting is not None and resting.still is not None and resting.still.sum() > 20


def test_the_strangers_are_not_what_the_guards_track() -> None:
    """Nothing here is tracked: one is opened, to see that it is one."""
    files = sorted((ROOT / "tests" / "data" / "strangers").glob("*.npz"))
    assert len(files) == 16 and open_recording(files[0]).truth is not None
    assert not {file.stem for file in files} & {*recordings("guards"), *recordings("empty")}


def test_a_turned_finger_is_turned_back() -> None:
    before = default_hand_shape().base_frames
    with BREAKS["finger's axis"].patched():
        turned = default_hand_shape().base_frames
    cosine = float((before[1, :, 0] * turned[1, :, 0]).sum())
    assert np.degrees(np.arccos(cosine)) == pytest.approx(5, abs=0.1)
    assert (default_hand_shape().base_frames == before).all()


def test_every_break_can_be_configured() -> None:
    for fault in BREAKS.values():
        configuration(*fault.overrides)
