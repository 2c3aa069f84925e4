"""toftrack.track: the estimates and results of a recording or device in a program of one's own."""

import csv
import errno
import json
import socket
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.programs import QUICK
from helpers.tracking import Camera, run, sample

import toftrack
from toftrack.devices.replay import Sample
from toftrack.output.lines import KINDS
from toftrack.programs import in_python
from toftrack.programs.recover import recover
from toftrack.recordings.npz import read_recording
from toftrack.recordings.sr_frame import nominal_camera

PAPER = ("experiment=paper", *QUICK)  # whose tracker is there at once
WORDS = ("device.name=two_hands", "hands=2", *QUICK)


@pytest.fixture(scope="module")
def tracking() -> toftrack.Tracking:
    return toftrack.track("device=sample", "device.stop=3", *WORDS)


@pytest.fixture(scope="module")
def results(tracking: toftrack.Tracking) -> toftrack.Results:
    return tracking.results()


def test_the_estimates_and_results_are_those_of_the_command_line(
    tracking: toftrack.Tracking, results: toftrack.Results, tmp_path: Path
) -> None:
    run(tmp_path, Sample("two_hands", stop=3), "view=none", *WORDS)
    of_run = toftrack.read_results(tmp_path / "track.npz")
    estimates = list(tracking)
    assert [estimate.index for estimate in estimates] == [0, 0, 1, 1, 2, 2]
    for name in ("joints_m", "lost", "side", "covariance", "openxr_position_m"):
        values = [np.asarray(getattr(one, name), of_run[name].dtype) for one in estimates]
        assert np.array_equal(getattr(results, name), of_run[name], equal_nan=name == "covariance")
        assert np.array_equal(np.array(values).reshape(of_run[name].shape), of_run[name])
    again, last = results.estimates(-1)[1], estimates[-1]
    assert (again.side, again.confidence) == (last.side, np.float32(last.confidence))
    assert str(results) == "<Results: 3 frames, 2 slots, 0% lost>" and "joints_m" in dir(results)
    assert all(hasattr(results, name) for name in dir(results)), "what completion offers is there"
    with pytest.raises(AttributeError, match="no array 'joint_m'; it has index, .*joints_m"):
        _ = results.joint_m


@pytest.mark.parametrize("kind", ["csv", "jsonl"])
def test_a_long_table_is_not_made_in_memory(results: toftrack.Results, tmp_path, kind: str) -> None:
    of_frames = {*KINDS, "dropped"}
    many = {
        name: np.repeat(value, 100, 0) if name in of_frames else value
        for name, value in results.content.items()
    }
    tracemalloc.start()
    toftrack.Results(many).save(path := tmp_path / f"hand.{kind}")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < path.stat().st_size / 2


def test_results_are_saved_as_a_run_saves_them(results: toftrack.Results, tmp_path: Path) -> None:
    for kind in ("npz", "jsonl", "csv"):
        results.save(tmp_path / f"hand.{kind}")
    with np.load(tmp_path / "hand.npz") as content:
        assert {"K", "image_size_px", "readme", "angle_names"} <= set(content.files)
    again = toftrack.Results(toftrack.read_results(tmp_path / "hand.npz"))
    assert np.array_equal(again.joints_m, results.joints_m)
    assert again.content["metadata"] == results.content["metadata"]
    lines = [json.loads(line) for line in (tmp_path / "hand.jsonl").read_text().splitlines()]
    assert [[hand["slot"] for hand in line["hands"]] for line in lines] == [[0, 1]] * 3
    assert lines[2]["image_size_px"] == [176, 144]
    with (tmp_path / "hand.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["index"], row["slot"]) for row in rows][-2:] == [("2", "0"), ("2", "1")]
    for name, words in (("hand.txt", "in .npz, .jsonl or .csv"), ("a/b.csv", "cannot be written")):
        with pytest.raises(toftrack.ToftrackError, match=words):
            results.save(tmp_path / name)


def test_results_are_drawn_on_the_image_of_their_frame(
    tracking: toftrack.Tracking, results: toftrack.Results
) -> None:
    picture = results.draw(tracking.depth_m, -1)
    both = toftrack.draw(tracking.depth_m, results.estimates(2), tracking.camera)
    assert np.array_equal(picture, both) and len(np.unique(picture.reshape(-1, 3), axis=0)) > 100


def test_results_become_a_table_of_pandas(results: toftrack.Results, monkeypatch) -> None:
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pandas", None)
        with pytest.raises(toftrack.ToftrackError, match="needs the package pandas.*pip install"):
            results.to_pandas()
    pytest.importorskip("pandas", reason="pip install '.[pandas]'")
    table = results.to_pandas()
    assert table["index"].tolist() == [0, 0, 1, 1, 2, 2] and table["lost"].dtype == bool
    assert np.allclose(table["wrist_z_m"], results.joints_m[..., 0, 2].ravel())


def test_results_name_the_whole_camera_that_was_calibrated(tmp_path: Path) -> None:
    lens = replace(nominal_camera(), depth_polynomial=(0.001, 0.01))
    lens = replace(lens, depth_polynomial_range_m=(0.3, 0.9))
    lens.save(tmp_path / "lens.json")
    given = (f"camera.file={tmp_path / 'lens.json'}", "device.stop=1", *QUICK)
    results = toftrack.track("device=sample", *given).results()
    said = results.content["metadata"]["camera"]
    assert toftrack.Camera(**said).to_dict() == lens.to_dict()


def test_the_device_is_closed_however_the_loop_ends() -> None:
    class Counted(Camera):
        opened = 0

        def open(self) -> None:
            self.opened += 1

        def close(self) -> None:
            self.opened -= 1

    for fails, leaves in ((None, False), (None, True), (toftrack.ToftrackError, False)):
        camera = Counted(3, live=False, fails=fails)
        try:
            for estimate in toftrack.track(camera, *PAPER):
                assert camera.opened == 1
                if leaves and estimate.index == 1:
                    raise ZeroDivisionError
            assert fails is None and not leaves
        except (ZeroDivisionError, toftrack.ToftrackError) as error:
            assert leaves or "unplugged" in str(error)
        assert camera.opened == 0


def test_a_program_that_ends_within_the_loop_ends_and_keeps_its_recording(tmp_path: Path) -> None:
    words = *PAPER, f'record="{tmp_path}/kept.npz"', "stream=websocket", "stream.port=0"
    program = f"import toftrack\nframes = iter(toftrack.track('device=sample', *{words}))"
    with subprocess.Popen([sys.executable, "-c", f"{program}\nnext(frames)"]) as process:
        try:
            assert process.wait(100) == 0
        finally:
            process.kill()
    assert len(read_recording(tmp_path / "kept.npz")) == 1


def test_loops_that_are_left_open_are_all_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    closed = []

    def loop(number: int) -> Iterator[None]:
        try:
            yield
        finally:
            closed.append(number)
            raise toftrack.ToftrackError("no room for its video")

    loops = [loop(number) for number in range(2)]
    for one in loops:
        next(one)
    monkeypatch.setattr(in_python, "_left_open", loops)
    with pytest.raises(toftrack.ToftrackError, match="no room"):
        in_python._close_loops()
    assert sorted(closed) == [0, 1]


def test_what_cannot_be_tracked_is_one_clear_sentence(tmp_path: Path) -> None:
    for words, said in (
        ([tmp_path / "gone.npz"], "there is no file"),
        (["device=sample", "hand.syde=left"], "did you mean"),
        (["device=sample", "a.npz"], "both give the frames"),
        ([np.zeros((9, 144, 176))], "but not ndarray"),
        ([Camera(3), "device.stop=2"], "track was given a device, a Camera; leave one out"),
    ):
        with pytest.raises(toftrack.ToftrackError, match=said):
            toftrack.track(*words)
    with pytest.raises(toftrack.ToftrackError, match="was given ndarray"):
        toftrack.PushDevice(np.eye(3))
    assert toftrack.BaseDevice(None).camera is None, "a device may know it only when it is open"


def test_ctrl_c_keeps_the_results_of_a_live_camera_alone() -> None:
    assert len(toftrack.track(Camera(2, fails=KeyboardInterrupt), *PAPER).results().lost) == 2
    with pytest.raises(KeyboardInterrupt):
        toftrack.track(Camera(2, live=False, fails=KeyboardInterrupt), *PAPER).results()
    ended = toftrack.PushDevice(Sample().camera)
    ended.end()
    with pytest.raises(toftrack.ToftrackError, match="no frame"):
        toftrack.track(ended, *PAPER).results()
    with pytest.raises(toftrack.ToftrackError, match="fps=0 is not possible"):
        toftrack.PushDevice(Sample().camera, 0)


def test_results_that_find_no_room_are_recovered_as_is_said(monkeypatch, tmp_path) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    tracking = toftrack.track("device=sample", "device.stop=3", *PAPER)
    with monkeypatch.context() as disk:
        disk.setattr("toftrack.output.results.write_results", full)
        with pytest.raises(toftrack.ToftrackError, match="No space left.*the 3 frames") as caught:
            tracking.results()
    folder = Path(str(caught.value).rpartition("`toftrack recover ")[2].rstrip("`"))
    assert folder.parent == tmp_path and recover(folder)
    assert len(toftrack.read_results(folder / "track.npz")["lost"]) == 3
    assert len(tracking.results().lost) == 3 and list(tmp_path.iterdir()) == [folder]
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    with pytest.raises(toftrack.ToftrackError, match="no temporary folder.*set TMPDIR"):
        tracking.results()


def test_estimates_are_sent_and_smoothed_where_overrides_say_so() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        words = ("stream=udp", f"stream.port={receiver.getsockname()[1]}", "smooth=one_euro")
        tracking = toftrack.track("device=sample", "device.stop=3", *words, *QUICK)
        smooth = [estimate.joints_m for estimate in tracking]
        sent = [json.loads(receiver.recv(65535)) for _ in smooth]
    assert np.allclose([line["joints_m"] for line in sent], smooth, atol=1e-6)
    assert not np.array_equal(tracking.results().joints_m[2], smooth[2])


@pytest.mark.parametrize(
    ("depth", "time_s"),
    [
        (np.ones((2, 2)), 0.0),
        (sample().depth_m[0], "a"),
        ((1000 * sample().depth_m[0]).astype(np.uint16), 0.0),
    ],
)
def test_what_is_no_frame_is_refused_where_it_is_pushed(depth: Any, time_s: Any) -> None:
    camera = toftrack.PushDevice(Sample().camera)
    with pytest.raises(toftrack.ToftrackError):
        camera.push(depth, time_s)
    camera.end()
    assert not list(camera) and camera.dropped == 0


def test_times_that_are_now_come_from_a_clock_that_is_fine_everywhere(monkeypatch) -> None:
    monkeypatch.setattr(time, "monotonic", lambda: 1.0)  # Windows had it tick 64 times a second
    depth, camera = sample().depth_m[0], toftrack.PushDevice(Sample().camera)
    tracker = toftrack.make_tracker("experiment=paper", "hand.side=right")
    first, second = (tracker.step(depth, sample().k).timestamp_s for _ in range(2))
    camera.push(depth)
    pushed = next(iter(camera)).timestamp_s
    assert 1.0 != first < second < pushed < second + 60


def test_of_frames_that_are_pushed_the_newest_is_tracked() -> None:
    depth, camera = sample().depth_m[:3].copy(), toftrack.PushDevice(Sample().camera)
    frames = iter(camera)
    camera.push(depth[0], 0.0)
    first = next(frames)
    for number in (1, 2):
        camera.push(depth[number], number / 25)
    depth[:] = 0  # the camera's own buffer
    camera.end()
    (last,) = frames
    assert (first.index, last.index, last.timestamp_s, camera.dropped) == (0, 2, 0.08, 1)
    assert np.array_equal(last.depth, sample().depth_m[2])
