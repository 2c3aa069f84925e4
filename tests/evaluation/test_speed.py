"""`toftrack benchmark speed` writes what it says."""

from __future__ import annotations

import json

import pytest

from toftrack.errors import ToftrackError
from toftrack.evaluation import speed
from toftrack.programs import benchmark


def test_a_small_run_writes_json(tmp_path, capsys, one_thread) -> None:
    file = tmp_path / "figures.json"
    arguments = ["--particles", "4", "8", "--seconds", "0.01", "--frames", "--json", str(file)]
    benchmark.main(["speed", *arguments])
    result = json.loads(file.read_text())
    rows = {(row["table"], row["method"], row["count"]): row for row in result["rows"]}
    assert all(0 < row["min_ms"] <= row["median_ms"] for row in rows.values())
    scored = {(method, count) for table, method, count in rows if table == "scoring"}
    assert {("stepping", 4), ("naive", 8), ("torch", 4), ("numba", 8)} <= scored
    # Speed is not for a test to judge, but this is off by orders of magnitude only if broken.
    medians = {key: row["median_ms"] for key, row in rows.items()}
    assert medians["scoring", "naive", 8] > 10 * medians["scoring", "numba", 8]
    assert {key[1] for key in rows if key[0] == "decoding"} == set(speed.SPACES)
    parts = {row["method"]: row["parts"] for row in result["rows"] if row["parts"]}
    kinds = ("", ", start", ", searching")
    assert set(parts) == {f"{name}{kind}" for name in ("default", "paper") for kind in kinds}
    assert parts["default"]["detector"] > 10 * parts["paper"]["detector"]
    assert parts["default, start"]["detector"] > parts["default"]["detector"]
    assert parts["default"]["refinement"] > parts["paper"]["refinement"]
    assert parts["paper"]["filter: scoring"] > 0
    assert "default, searching" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--compute", "cuda"], ["--particles", "0"]])
def test_what_cannot_be_timed_is_reported(words, monkeypatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises((ToftrackError, SystemExit)):
        benchmark.main(["speed", *words])
