"""What the guards say, and what they cannot see."""

import sys
from pathlib import Path

import numpy as np

from toftrack.recordings.store import open_recording

sys.path.insert(0, str(Path(__file__).parent))
from guards import BOUNDS, DATA, SAMPLE_MM, complaints

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
    """Opened is one of each kind, as all of them take seconds."""
    folders = ("guards", "empty", "strangers")
    guards, empty, strangers = (sorted((DATA / name).glob("*.npz")) for name in folders)
    assert (len(guards), len(empty), len(strangers)) == (8, 10, 16)
    assert not {file.stem for file in strangers} & {file.stem for file in (*guards, *empty)}
    for path in (*guards, *empty):
        with np.load(path) as file:
            assert len(file["joints_m"]) == 40 and file["visible"].any() == (path in guards)
    resting = open_recording(DATA / "guards" / "still_face.npz").truth
    assert resting is not None and resting.still is not None and resting.still.sum() > 20
    assert open_recording(strangers[0]).truth is not None
