"""`python track.py` from end to end: what it writes, what it says, and how it fails."""

import io
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import programs
from helpers.programs import QUICK
from helpers.tracking import ROOT, sample
from helpers.videos import video_frames

from toftrack.frames.estimate import STATES
from toftrack.hand.shape import Fitted, HandShape, default_hand_shape
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.results import ResultWriter, read_results
from toftrack.output.run_folder import read_run
from toftrack.programs.export import export
from toftrack.programs.recover import recover
from toftrack.programs.track import _ShapeFiles
from toftrack.recordings.image_folder import write_image_folder
from toftrack.recordings.store import open_sample
from toftrack.views.overlay import caption_px

K = np.array([[200.0, 0, 20], [0, 200.0, 15], [0, 0, 1]])


@pytest.fixture
def here(tmp_path: Path) -> Callable[..., tuple[int, str, str]]:
    """`python track.py` within this process, with `out` for its folder."""
    return partial(programs.call, "hydra.run.dir=out", folder=tmp_path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, str, str]:
    """The output folder, status, standard output and standard error of one ordinary run."""
    folder = tmp_path_factory.mktemp("whole")
    kept = ("record=kept.npz", "record_limit_gb=0.0004")
    given = ("device.stop=12", "hydra.run.dir=deep/er", *kept, *QUICK)
    reported = programs.call(*given, folder=folder)
    return folder / "deep" / "er", *reported


def test_a_run_writes_its_files_directly_into_its_folder(whole) -> None:
    folder, status, _, err = whole
    assert status == 0, err
    for name in ("track.npz", "track.jsonl", "summary.json", "overlay.mp4", "overlay.png"):
        assert (folder / name).stat().st_size > 0, name
    assert not list(folder.glob("*.part"))


def test_a_log_has_no_progress_bar(whole) -> None:
    assert "\r" not in whole[-1]


def test_what_is_logged_meanwhile_stands_on_a_line_of_its_own(whole) -> None:
    folder, _, _, err = whole
    assert re.search(r"[\r\n]the recording 'kept.npz' ends after \d frames.*\n", err)
    assert "the recording 'kept.npz' ends" in (folder / "track.log").read_text()


def test_track_npz_says_whose_hand_and_how_it_was_tracked(whole) -> None:
    with np.load(whole[0] / "track.npz", allow_pickle=False) as archive:
        assert archive["joint_names"].tolist() == list(JOINT_NAMES)
        assert (archive["side"] == "right").all()
        for name in ("confidence", "score", "side_probability"):
            assert ((archive[name] >= 0) & (archive[name] <= 1)).all(), name
        metadata = json.loads(archive["metadata"].item())
        assert np.isfinite(archive["joints_m"]).all()
        assert np.allclose(archive["timestamp_s"], np.arange(12) / 25)
    assert {"toftrack", "torch", "numpy"} <= set(metadata) and metadata["seed"] == 0
    assert metadata["device"]["device"] == "sample" and metadata["device"]["stop"] == 12
    assert metadata["pose_space"] == {"kind": "pca", "dims": 4}
    assert metadata["camera"]["width"] == 176 and metadata["camera"]["K"][0][0] == 200
    assert metadata["hand_shape"]["side"] == "auto", "nobody told"


def test_track_jsonl_says_the_same_a_line_a_frame(whole) -> None:
    lines = [json.loads(line) for line in (whole[0] / "track.jsonl").read_text().splitlines()]
    result = read_results(whole[0] / "track.npz")
    assert [line["index"] for line in lines] == list(range(12))
    exact = ("joints_m", "lost", "state", "latent", "score", "covariance", "timestamp_s")
    for name in (*exact, "confidence", "outside_rad", "side", "state_name", "index"):
        reported = np.array([line[name] for line in lines], result[name].dtype)
        assert np.array_equal(reported, result[name]), name
    assert {line["state_name"] for line in lines} <= STATES.keys()


def test_the_summary_is_of_the_same_frames_and_holds_the_metrics(whole) -> None:
    summary = json.loads((whole[0] / "summary.json").read_text())
    result = read_results(whole[0] / "track.npz")
    assert summary["frames"] == 12 and summary["lost_frames"] == int(result["lost"].sum())
    error = 1e3 * np.linalg.norm(result["joints_m"][5:] - sample().joints_m[5:12], axis=-1)
    assert summary["metrics"]["mean_mm"] == pytest.approx(error.mean(), rel=1e-4)
    assert summary["metrics"]["mean_mm"] < 15
    assert 0 <= summary["metrics"]["trust"]["usable_pct"] <= 100
    assert whole[2].startswith("usable ")


def test_a_run_of_a_wall_ends_with_what_to_try(here, tmp_path: Path) -> None:
    wall = np.full((3, 30, 40), 1.6, np.float32)
    wall[:, 0, 0] = 1.5
    np.savez(tmp_path / "wall.npz", depth_m=wall, K=K)
    status, out, err = here("device=replay", "device.path=wall.npz", "view=none")
    notes = [line for line in err.splitlines() if line.startswith("note: ")]
    assert status == 0 and "frames        3, 3 of them lost" in out
    assert len(notes) == 2
    assert "100 % of the pixels had readings, from 1.60 to 1.60 m" in notes[0]
    assert "segmentation.max_distance_m" in notes[1]


def test_a_run_that_is_terminated_keeps_what_was_done(tmp_path: Path) -> None:
    endless = (str(ROOT / "track.py"), "device.repeat=true", "hydra.run.dir=out")
    command = [sys.executable, *endless, *QUICK]
    env = os.environ | {"HYDRA_FULL_ERROR": "0", "OMP_NUM_THREADS": "1"}
    said = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen(command, cwd=tmp_path, env=env, text=True, **said)
    lines = tmp_path / "out" / "track.jsonl"
    for _ in range(20_000):  # of 10 ms, in which kernels may be compiled and this process is awake
        if lines.exists() and lines.read_text().count("\n") >= 3:
            break
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    process.send_signal(signal.SIGHUP)  # as a system does that shuts down
    out, err = process.communicate(timeout=60)
    assert process.returncode in (143, 129), err
    assert "interrupted" in err and "Traceback" not in err
    assert "time a frame" in out and "overlay.mp4" in out
    done = [json.loads(line) for line in lines.read_text().splitlines()]
    assert len(done) >= 3
    result = read_results(tmp_path / "out" / "track.npz")
    assert len(result["joints_m"]) == len(done)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["frames"] == len(done) and summary["complete"] is False
    assert len(video_frames(tmp_path / "out" / "overlay.mp4")) == len(done)
    assert HandShape.load(tmp_path / "out" / "hand_shape.json").side == "right"


def test_the_file_of_a_hand_holds_the_one_whose_fit_rests_on_most_poses(tmp_path: Path) -> None:
    def hand(length_m: float, poses: float = 0.0) -> HandShape:
        fitted = Fitted(("length",), (0.0,), ((0.01,),), poses, False) if poses else None
        return replace(default_hand_shape(length_m), fitted=fitted)

    tracker: Any = SimpleNamespace(states=[SimpleNamespace(track=-1)], fitted=(hand(0.19),))
    files = _ShapeFiles(tmp_path, tracker)
    for track, present, length_mm in (
        (0, hand(0.185), 185),
        (0, hand(0.179, 5.0), 179),
        (1, hand(0.148), 179),  # found again: a guess
        (1, hand(0.165, 6.0), 165),
        (1, hand(0.172), 172),  # its fit was contradicted
    ):
        tracker.states[0].track, tracker.fitted = track, (present,)
        files.save(last=True)
        written = HandShape.load(tmp_path / "hand_shape.json")
        assert 1e3 * written.hand_length_m == pytest.approx(length_mm)


def test_a_recording_is_tracked_by_its_name_alone_and_a_killed_run_recovered(
    here, tmp_path: Path
) -> None:
    name = "Übung 'eins' [2]=a,b.npz"
    shutil.copy(ROOT / "toftrack" / "data" / "sample.npz", tmp_path / name)
    status, _, err = here(name, "device.start=10", "device.stop=14", "view=none", *QUICK)
    assert status == 0 and f"tracking {name} (4 frames): a hand of either side" in err
    before = read_results(tmp_path / "out" / "track.npz")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert before["metadata"]["device"]["recording"] == name
    for made in ("track.npz", "summary.json"):
        (tmp_path / "out" / made).unlink()
    with open(tmp_path / "out" / "track.jsonl", "a") as lines:
        lines.write('{"index":14,"times')  # as a killed run leaves it
    recover(tmp_path / "out")
    after = read_results(tmp_path / "out" / "track.npz")
    assert after.keys() == before.keys()
    for key, values in before.items():
        np.testing.assert_array_equal(after[key], values, key)
    recovered = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert recovered == summary | {"complete": False}
    assert summary["metrics"]["trust"]["visible"] == 4 and summary["hand"]["side"] == "right"


def test_of_three_slots_that_are_asked_for_two_have_a_hand(tmp_path: Path) -> None:
    sample = ("device=sample", "device.name=two_hands", "device.stop=3", "hydra.run.dir=out")
    status, _, err = programs.call(*sample, "hands=3", "view=video", *QUICK, folder=tmp_path)
    assert status == 0 and "up to 3 hands, their lengths to be fitted" in err, err
    folder = tmp_path / "out"
    run = read_run(folder)
    assert run.results["joints_m"].shape == (3, 3, 21, 3) and len(run.shapes) == 3
    assert run.results["lost"].all(0).tolist() == [False, False, True]
    assert set(run.results["side"][-1].tolist()) == {"right", "left", ""}
    first = json.loads((folder / "track.jsonl").read_text().splitlines()[0])["hands"][0]
    assert first["slot"] in (0, 1) and first["side"] in ("right", "left")
    summary = json.loads((folder / "summary.json").read_text())
    assert [slot["frames"] for slot in summary["slots"]] == [3, 3, 0] and "hand" not in summary
    assert summary["metrics"]["ghost_pct"] == 0 and summary["metrics"]["second"]["slot"] in (0, 1)
    height = video_frames(folder / "overlay.mp4")[0].shape[0]
    assert height == caption_px(3) + 3 * 144
    assert [path.name for path in export(folder, "bvh")] == ["hand1.bvh", "hand2.bvh"]


def test_a_sweep_over_seeds_runs_each(tmp_path: Path) -> None:
    sweep = ("-m", "seed=1,2", "hydra.sweep.dir=sweep", "device.stop=3", "view=none")
    status, out, err = programs.call(*sweep, *QUICK, folder=tmp_path)
    assert status == 0, err
    lines = out.splitlines()
    assert len(lines) == 2 and lines[1].startswith("#1 seed=2 ") and " 3 frames, " in lines[1]
    said = [line for line in err.splitlines() if "compiling" not in line]
    assert not said, "one line a job, and no more"
    one, two = (read_results(tmp_path / "sweep" / n / "track.npz") for n in ("0", "1"))
    assert (one["metadata"]["seed"], two["metadata"]["seed"]) == (1, 2)
    assert not np.array_equal(one["joints_m"], two["joints_m"])


def test_a_view_that_cannot_come_up_leaves_no_files_and_those_that_were_there(
    here, tmp_path: Path
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        view = "view=browser", f"view.port={taken.getsockname()[1]}"
        status, _, err = here("device.stop=1", *view)
        assert status == 1 and "is taken" in err and not (tmp_path / "out").exists()
        with ResultWriter(tmp_path / "out", {}, JOINT_NAMES):
            pass
        before = (tmp_path / "out" / "track.npz").read_bytes()
        assert here("device.stop=1", *view)[0] == 1
    assert (tmp_path / "out" / "track.npz").read_bytes() == before


def test_a_folder_that_is_used_again_lists_what_this_run_wrote(here, tmp_path) -> None:
    with ResultWriter(tmp_path / "out", {}, JOINT_NAMES):
        pass
    for name in ("overlay.mp4", "hand.csv"):
        (tmp_path / "out" / name).write_text("of the first run")
    _, out, err = here("device.stop=2", "view=none", *QUICK)
    assert "earlier run" in err and "track.npz" in out
    assert "overlay.mp4" not in out and "hand.csv" not in out
    assert (tmp_path / "out" / "hand.csv").exists()
    assert "earlier run" in (tmp_path / "out" / "track.log").read_text()  # which goes on


def test_the_log_has_names_that_the_system_s_encoding_lacks(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(io, "text_encoding", lambda given, _=2: given or "cp1252")  # on Windows
    with ResultWriter(tmp_path / "手", {}, JOINT_NAMES):
        pass
    given = ("device.stop=2", "view=none", *QUICK, "hydra.run.dir=手")
    _, _, err = programs.call(*given, folder=tmp_path)
    assert "Logging error" not in err
    assert "手" in (tmp_path / "手" / "track.log").read_text("utf-8")


def test_what_was_written_before_an_error_is_kept(here, tmp_path) -> None:
    """A folder of images whose third one is damaged."""
    write_image_folder(tmp_path / "images", open_sample())
    third = tmp_path / "images" / "depth_000002.png"
    third.write_bytes(third.read_bytes()[:200])
    status, _, err = here("device=replay", "device.path=images", "view=none", *QUICK)
    assert status == 1
    assert err.splitlines()[-1].startswith("error: ") and third.name in err.splitlines()[-1]
    assert len(read_results(tmp_path / "out" / "track.npz")["joints_m"]) == 2
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["frames"] == 2
