"""Measuring the pose network on single frames: the figures are those of its errors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from toftrack.detector.weights import DEFAULT_FILE
from toftrack.errors import ToftrackError
from toftrack.programs import measure_detector as program

pytestmark = pytest.mark.usefixtures("one_thread")

SAMPLE = DEFAULT_FILE.parent / "sample.npz"


def test_figures_are_those_of_the_errors() -> None:
    error = np.full((4, 21), 0.010)
    error[0] = 0.020
    error[1, 8] = 0.050
    names = np.array(["a", "a", "b", "b"])
    tables = program.Misses(error, names, np.array(["fist", "palm", "palm", "palm"])).tables()
    assert tables["all"]["all"]["frames"] == 4
    assert tables["all"]["all"]["within_40_mm"] == 75
    assert tables["pose"]["fist"]["mean_mm"] == 20 and tables["pose"]["palm"]["frames"] == 3
    assert tables["recording"]["a"]["within_40_mm"] == 50


def test_weights_are_compared_on_a_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again = ["--weights", str(DEFAULT_FILE), "--json", str(tmp_path / "figures.json")]
    copy = tmp_path / "copy.npz"
    copy.write_bytes(DEFAULT_FILE.read_bytes())
    program.main([str(SAMPLE), "--every", "40", "--weights", str(copy), *again[:2]])
    program.main([str(SAMPLE), "--every", "20", *again])
    assert "weights 2" in capsys.readouterr().out
    figures = json.loads((tmp_path / "figures.json").read_text())[str(DEFAULT_FILE)]
    whole = figures["all"]["all"]
    assert whole["frames"] > 2 and whole["mean_mm"] < 20 and whole["within_40_mm"] > 60
    assert list(figures["recording"]) == ["sample"]


def test_what_cannot_be_measured_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ToftrackError, match="there are no recordings"):
        program.main([str(tmp_path)])
    with pytest.raises(ToftrackError, match="every"):
        program.main([str(SAMPLE), "--every", "0"])
    with np.load(SAMPLE) as content:
        arrays = {key: content[key] for key in ("depth_m", "K", "fps") if key in content}
    np.savez(tmp_path / "bare.npz", **arrays)
    with pytest.raises(ToftrackError, match=r"bare.npz has no true joints"):
        program.main([str(tmp_path / "bare.npz")])
