"""The benchmark's command writes what it says."""

from __future__ import annotations

import json

import pytest
import torch
from helpers.accelerator import pretended_device
from helpers.pretended_triton import pretended_triton

from toftrack.benchmark import frames as frame_timing
from toftrack.benchmark import scoring as benchmark
from toftrack.errors import ToftrackError


@pytest.fixture
def quick(monkeypatch):
    """One thread, because idle helpers of torch hold up small work on a busy machine."""
    monkeypatch.setattr(benchmark, "fastest_chunk", lambda *_: 4)
    monkeypatch.setattr(benchmark, "UPSAMPLED", (0.5, 1.0))
    monkeypatch.setattr(benchmark, "_SLOW_REPEATS", {"stepping": 1, "naive": 1})
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def test_a_small_run_writes_json(tmp_path, capsys, quick):
    file = tmp_path / "figures.json"
    arguments = ["--particles", "4", "8", "--seconds", "0.01", "--frames", "--json", str(file)]
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
        "decoding",
        "notes",
    }
    tables = {row["table"] for row in result["rows"]}
    assert tables == {"particles", "pixels", "ellipsoids", "kinematics and conics"}
    timed = {(row["method"], row["particles"]) for row in result["rows"]}
    assert {("stepping", 4), ("naive", 8), ("torch", 4), ("numba", 8)} <= timed
    assert all(0 < row["min_ms"] <= row["median_ms"] for row in result["rows"])
    # Speed is not for a test to judge, but this is off by orders of magnitude only if broken.
    assert result["ratios"]["numba, N = 8"]["naive"] > 10
    assert result["largest_difference_px"]["numba"] <= 3
    frames = {row["configuration"]: row for row in result["frames"]}
    kinds = ("", ", start", ", searching")
    expected = {f"{name}{kind}" for name in ("default", "paper") for kind in kinds}
    assert set(frames) == expected | {"default, 640x480", "default, 1280x720"}
    assert all(0 < row["min_ms"] <= row["median_ms"] for row in frames.values())
    assert all(set(row["parts"]) == set(frame_timing.PARTS) for row in frames.values())
    compared = {name: row["parts"]["detector"] for name, row in frames.items()}
    assert (
        compared["default"] > 10 * compared["paper"]
        and compared["default, start"] > compared["default"]
    )
    assert frames["default"]["parts"]["refinement"] > frames["paper"]["parts"]["refinement"]
    assert 0 < frames["paper"]["parts"]["filter: scoring"] < frames["paper"]["median_ms"]
    spaces = {row["space"]: row for row in result["decoding"]}
    assert set(spaces) == {"pca", "kernel_pca", "lle", "isomap"}
    assert all(row["latents"] == 10_000 for row in spaces.values())
    assert all(0 < row["min_ms"] <= row["median_ms"] for row in spaces.values())
    printed = capsys.readouterr().out
    assert "median ms" in printed and "numba" in printed
    assert printed.count("frames/s") == 8 and "default, searching" in printed
    assert printed.count("decoding latents") == 4 and "kernel_pca" in printed


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_s_run_times_whole_frames_at_each_number_of_particles(capsys, quick, monkeypatch):
    monkeypatch.setattr(frame_timing, "CONFIGURATIONS", {"default": ()})
    monkeypatch.setattr(frame_timing, "SIZES", ())
    monkeypatch.setattr(frame_timing, "_FEWEST", 2)
    monkeypatch.setattr(benchmark, "UPSAMPLED", ())
    monkeypatch.setattr(benchmark, "decode_times", lambda **_: [])
    monkeypatch.setattr("torch.cuda.synchronize", lambda *_: None)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda: "none at all")
    arguments = ["--compute", "cuda", "--particles", "4", "--seconds", "0", "--no-baselines"]
    with pretended_device() as counts, pretended_triton(counts):
        assert benchmark.main([*arguments, "--frames"]) == 0
    printed = capsys.readouterr().out
    assert "none at all" in printed and "triton: counts within" in printed
    assert "default, 4 " in printed


def test_whole_frames_need_the_configuration(tmp_path, monkeypatch):
    monkeypatch.setattr(frame_timing, "_CONF", tmp_path)
    with pytest.raises(ToftrackError, match="no configuration files"):
        frame_timing.frame_times(0.01, torch.device("cpu"))


def test_the_device_must_exist(capsys, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert benchmark.main(["--compute", "cuda", "--particles", "8"]) == 1
    assert "no CUDA device" in capsys.readouterr().err


def test_particles_must_be_positive():
    with pytest.raises(SystemExit):
        benchmark.main(["--particles", "0"])
