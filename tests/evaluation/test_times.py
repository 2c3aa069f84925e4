"""Programs that are timed in turn, and `toftrack benchmark speed`."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.evaluation import accuracy, alternating, speed
from toftrack.evaluation.alternating import FIRST, PEER_HANDS, Program, Times, runner, show, timed
from toftrack.programs import benchmark

LEFT = str(Path(alternating.__file__).parents[1] / "data" / "sample_left_hand.npz")


def times(name: str, *rounds: float) -> Times:
    """Of ten frames a round, all but two of which take as long."""
    return Times(name, [[ms] * 8 + [0.5 * ms, 3 * ms] for ms in rounds])


def test_the_table_has_the_ratios_and_the_starts() -> None:
    found = [
        times(FIRST, 5.0, 6.0),
        times("a, one hand", 10.0, 10.0),
        times("a, both", 15.0, 16.0),
        times(next(iter(PEER_HANDS)), 20.0, 20.0),
    ]
    names = ("kernels", "first_s", "wall_s", "user_s", "system_s")
    begun = [
        dict(zip(names, values, strict=True))
        for values in ((False, 12.0, 14.0, 20.0, 1.7), (True, 3.0, 3.9, 4.0, 0.5))
    ]
    said = show(found, begun).splitlines()
    figures = ("5.5 (5.0, 6.0)", "1.20 (1.20, 1.20)", "0.28 (0.25, 0.30)")  # round by round
    assert said[1].startswith(FIRST) and all(one in said[1] for one in figures)
    assert said[5].startswith("a, both over one hand: median 1.55 (1.50, 1.60)")
    assert said[6].startswith("three frames without kernels") and "14.0" in said[6]
    assert said[7].startswith("three frames with kernels") and "3.9" in said[7]


def test_frames_count_in_which_the_hands_are_believed(tmp_path) -> None:
    short = tmp_path / "short.npz"
    with np.load(LEFT) as sample:
        np.savez(short, **{k: v[:15] if v.shape[:1] == (80,) else v for k, v in sample.items()})
    quick = ("hand.side=left", "experiment=paper")
    assert 0 < len(runner(Program("one", quick, str(short), hands=1))()) <= 5
    with pytest.raises(ToftrackError, match="none of its frames has 2"):
        runner(Program("two", quick, str(short), hands=2))()


def test_what_a_program_s_process_cannot_do_is_one_sentence() -> None:
    with pytest.raises(ToftrackError, match="wrong"):
        timed([Program("wrong", ("nothing=1",))], 1)


def test_a_small_run_writes_json(tmp_path, capsys) -> None:
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
    assert {key[1] for key in rows if key[0] == "decoding"} == set(speed.KINDS)
    parts = {row["method"]: row["parts"] for row in result["rows"] if row["parts"]}
    kinds = ("", ", start", ", searching")
    assert set(parts) == {f"{name}{kind}" for name in ("default", "paper") for kind in kinds}
    assert parts["default"]["detector"] > 10 * parts["paper"]["detector"]
    assert parts["default, start"]["detector"] > parts["default"]["detector"]
    assert parts["default"]["refinement"] > parts["paper"]["refinement"]
    assert parts["paper"]["filter: scoring"] > 0
    assert "default, searching" in capsys.readouterr().out


def test_rows_are_printed_as_they_come(monkeypatch, capsys) -> None:
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr(speed, "decode_times", interrupted)
    with pytest.raises(KeyboardInterrupt):
        benchmark.main(["speed", "--particles", "4", "--seconds", "0.01", "--no-baselines"])
    out = capsys.readouterr().out.splitlines()
    assert [line.split()[:3] for line in out if line.startswith("scoring")] == [
        ["scoring", "torch", "4"],
        ["scoring", "numba", "4"],
    ]
    assert [line for line in out if "triton" in line] == [
        line for line in out if line.startswith("note: triton is not timed")
    ]


@pytest.mark.parametrize("words", [["--compute", "cuda"], ["--particles", "0"]])
def test_what_cannot_be_timed_is_reported(words, monkeypatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises((ToftrackError, SystemExit)):
        benchmark.main(["speed", *words])


@pytest.mark.parametrize("place", ["link", "pipe", "folder", "gone/file", "read_only"])
@pytest.mark.parametrize("command", ["speed", "alternating", "accuracy"])
def test_what_cannot_be_written_is_said_before_anything_is_measured(
    command, place, tmp_path, monkeypatch
) -> None:
    def measured(*_: object) -> None:
        raise AssertionError

    for module, name in ((speed, "run"), (alternating, "measure"), (accuracy, "run_jobs")):
        monkeypatch.setattr(module, name, measured)
    monkeypatch.chdir(tmp_path)
    Path("mine").write_text("mine")
    Path("link").symlink_to("mine")
    os.mkfifo("pipe")
    Path("folder").mkdir()
    Path("read_only").write_text("mine")
    if place == "read_only":  # which nothing is for the superuser
        monkeypatch.setattr("os.access", lambda path, mode: str(path) != place)
    given = [str(Path(alternating.__file__).parents[1] / "data")] * (command == "accuracy")
    with pytest.raises(ToftrackError, match=f"'{place}' cannot be written .*; give another name"):
        benchmark.main([command, *given, "--json", place])
    assert Path("mine").read_text() == "mine"
