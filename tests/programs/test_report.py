"""The report of a sweep: gathering jobs, means and spreads, failures, the table and the plot."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from toftrack.errors import ToftrackError
from toftrack.programs.report import Group, group_runs, main, read_runs, report, sweep_figure


def job(folder: Path, number: int, overrides: list[str], **summary: object) -> None:
    """A job's folder as its program leaves it."""
    path = folder / str(number)
    (path / ".hydra").mkdir(parents=True)
    (path / ".hydra" / "overrides.yaml").write_text("".join(f"- {o}\n" for o in overrides))
    (path / "summary.json").write_text(json.dumps(summary))


def tracked(error: float, ms: float = 20.0) -> dict[str, object]:
    """The summary of a run over a recording with truth."""
    return {"frames": 10, "median_ms": ms, "metrics": {"mean_mm": error}}


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """Two spaces, two seeds, two recordings."""
    number = 0
    for space, base, ms in (("pca", 10.0, 20.0), ("lle", 14.0, 30.0)):
        for seed in (0, 1):
            for name, harder in (("one", 0.0), ("two", 4.0)):
                given = [f"pose_space={space}", f"seed={seed}", f"device.path=d/{name}.npz"]
                found = tracked(base + 2 * seed + harder, ms)
                job(tmp_path, number, [*given, "view=none"], **found)
                number += 1
    return tmp_path


def test_jobs_that_differ_only_in_seed_and_recording_are_one_group(sweep: Path) -> None:
    runs = read_runs(sweep)
    assert len(runs) == 8
    pca, lle = group_runs(runs, "metrics.mean_mm")
    assert (pca.settings, lle.settings) == ("pose_space=pca", "pose_space=lle")
    assert pca.error == pytest.approx(13.0) and lle.error == pytest.approx(17.0)
    assert pca.spread == pytest.approx(2**0.5)  # of the seeds' means 12 and 14
    assert (pca.cost_ms, lle.cost_ms) == (20.0, 30.0)
    assert pca.recordings == pytest.approx({"d/one.npz": 11.0, "d/two.npz": 15.0})


def test_the_report_writes_a_table_a_csv_and_a_plot(sweep: Path, capsys) -> None:
    main([str(sweep)])
    text = capsys.readouterr().out
    assert "13.00" in text and "pose_space=lle" in text and "view=none" not in text
    assert "one" in text and "11.00" in text
    with open(sweep / "sweep.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 8
    assert rows[7]["device.path"] == "d/two.npz" and float(rows[7]["metrics.mean_mm"]) == 20.0
    assert cv2.imread(str(sweep / "sweep.png")).std() > 0


def test_recordings_of_one_name_are_told_apart_by_their_folders(tmp_path: Path, capsys) -> None:
    paths = ("mine/one.npz", "yours/one.npz", "yours/one.srs", "./mine/../mine/one.npz")
    for number, path in enumerate(paths):
        job(tmp_path, number, [f"device.path=data/{path}"], **tracked(10.0 + number))
    main([str(tmp_path)])
    text = capsys.readouterr().out
    assert text.count("mine/one") == 1 and "yours/one.npz" in text and "yours/one.srs" in text
    assert "data" not in text


def test_runs_that_were_interrupted_are_named(sweep: Path, capsys) -> None:
    path = sweep / "3" / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"complete": False}))
    main([str(sweep)])
    assert "1 of 8 runs were interrupted, and count with" in capsys.readouterr().out


def test_a_recording_without_a_pose_in_the_space_compares_all_frames(sweep: Path, capsys) -> None:
    for number in range(8):
        path = sweep / str(number) / "summary.json"
        content = json.loads(path.read_text())
        content["metrics"]["trust"] = {"mean_all_mm": 30.0}
        if number == 2:
            content["metrics"]["mean_mm"] = None
        path.write_text(json.dumps(content))
    main([str(sweep)])
    assert "trust.mean_all_mm" in capsys.readouterr().out


def test_jobs_that_failed_are_named_and_left_out_of_the_means(sweep: Path, capsys) -> None:
    (sweep / "2" / "summary.json").write_text('{"frames": 3, "error": "no hand anywhere"}')
    (sweep / "4" / "summary.json").unlink()
    (sweep / "5" / "summary.json").write_text("{broken")
    main([str(sweep)])
    text = capsys.readouterr().out
    assert "3 of 8 jobs failed" in text
    assert "2 (pose_space=pca seed=1 device.path=d/one.npz): no hand anywhere" in text
    assert "it did not finish" in text and "cannot be read" in text
    pca, lle = group_runs(read_runs(sweep), "metrics.mean_mm")
    assert pca.error == pytest.approx((10 + 14 + 16) / 3)
    assert pca.spread is None  # one seed lacks a recording: its mean is of something else
    assert sum(run.error is not None for run in lle.runs) == 2


def test_what_jobs_say_cannot_command_the_terminal(sweep: Path, capsys) -> None:
    (sweep / "2" / "summary.json").write_text(json.dumps({"error": "no hand\x1b]0;mine\x07"}))
    overrides = yaml.safe_dump(["pose_space=\x1b[31m", "seed=1"])
    (sweep / "4" / ".hydra" / "overrides.yaml").write_text(overrides)
    main([str(sweep)])
    text = capsys.readouterr().out
    assert "no hand ]0;mine" in text and "[31m" in text and "\x1b" not in text


def test_without_truth_the_score_is_compared(tmp_path: Path, capsys) -> None:
    for seed in range(2):
        job(tmp_path, seed, [f"seed={seed}"], mean_score=0.9)
    _, (group,) = report(tmp_path)
    assert group.error == pytest.approx(0.9) and group.settings == "all alike"
    assert "mean_score" in capsys.readouterr().out


def test_sweeps_of_training_compare_held_out_degrees_and_have_no_plot(tmp_path: Path) -> None:
    for number, kind in enumerate(("pca", "lle")):
        job(tmp_path, number, [f"pose_space={kind}"], reached_degrees=5.0 + number)
    _, groups = report(tmp_path)
    assert [group.error for group in groups] == [5.0, 6.0]
    assert (tmp_path / "sweep.csv").exists() and not (tmp_path / "sweep.png").exists()


def test_spaces_are_not_compared_by_their_own_training_poses(tmp_path: Path, capsys) -> None:
    for number, figures in enumerate(({"reached_degrees": 6.2}, {})):
        dims = [f"pose_space.dims={6 + number}"]
        job(tmp_path, number, dims, training_degrees=1.2 - number, **figures)
    _, groups = report(tmp_path)
    assert [group.error for group in groups] == [6.2, None]
    assert "1 of 2 runs have no reached_degrees" in capsys.readouterr().out


def test_another_figure_can_be_asked_for(sweep: Path) -> None:
    _, groups = report(sweep, "median_ms")
    assert [group.error for group in groups] == [20.0, 30.0]
    with pytest.raises(ToftrackError, match="no job has the figure beauty"):
        main([str(sweep), "--figure", "beauty"])


def test_jobs_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (10, 2, 1):
        job(tmp_path, number, [f"seed={number}"])
    assert [run.name for run in read_runs(tmp_path)] == ["1", "2", "10"]


def test_a_folder_without_jobs_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(ToftrackError, match="no folder .* with jobs"):
        read_runs(tmp_path)
    with pytest.raises(ToftrackError, match="one folder, but 2 .* to compare runs, move them"):
        main(["a", "b"])
    with pytest.raises(ToftrackError, match="no folder"):
        main([str(tmp_path / "nothing")])


@pytest.mark.parametrize("error", [0.0, 3e4])
def test_the_plot_holds_errors_of_any_size(error: float) -> None:
    points = [("one", error, None, 20.0), ("two", error, error / 2, 20.0), ("three", 1.0, 0, 0.0)]
    picture = sweep_figure([Group(name, [], *numbers, {}) for name, *numbers in points], "mm")
    assert picture.dtype == np.uint8 and picture.std() > 0
