"""The benchmark's command writes what it says."""

from __future__ import annotations

import json

import pytest

from toftrack import benchmark


def test_a_small_run_writes_json(tmp_path, capsys):
    file = tmp_path / "figures.json"
    arguments = ["--particles", "8", "16", "--seconds", "0.01", "--frames", "--json", str(file)]
    assert benchmark.main(arguments) == 0
    result = json.loads(file.read_text())
    assert set(result) == {
        "machine",
        "image",
        "radius_px",
        "rows",
        "ratios",
        "largest_difference_px",
        "peak_memory_gb",
        "frames",
        "notes",
    }
    tables = {row["table"] for row in result["rows"]}
    assert tables == {"particles", "pixels", "ellipsoids", "kinematics and conics"}
    timed = {(row["method"], row["particles"]) for row in result["rows"]}
    assert {("stepping", 8), ("naive", 16), ("torch", 8), ("numba", 16)} <= timed
    assert all(0 < row["min_ms"] <= row["median_ms"] for row in result["rows"])
    # Speed is not for a test to judge, but this is off by orders of magnitude only if broken.
    assert result["ratios"]["numba, N = 16"]["naive"] > 10
    assert result["largest_difference_px"]["numba"] <= 3
    printed = capsys.readouterr().out
    assert "median ms" in printed and "numba" in printed


def test_the_device_must_exist(capsys, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert benchmark.main(["--compute", "cuda", "--particles", "8"]) == 1
    assert "no CUDA device" in capsys.readouterr().err


def test_particles_must_be_positive():
    with pytest.raises(SystemExit):
        benchmark.main(["--particles", "0"])
