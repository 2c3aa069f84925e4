"""`view=rerun`: what lies in its file, what a viewer is sent, and how it fails."""

import dataclasses
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers.moments import tracked, two_hands, with_hand
from helpers.programs import QUICK, free_port
from helpers.settings import f_measure
from helpers.tracking import configuration, make_tracker
from hydra.utils import instantiate

import toftrack.views
from toftrack.configuration.sentences import sentence
from toftrack.devices.replay import Sample
from toftrack.errors import ToftrackError
from toftrack.views.base import TrackedFrame
from toftrack.views.classified import classify

FRAMES = 6
NAN = np.full(27, np.nan, np.float32)


def test_without_rerun_a_sentence_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    # Another test may have imported it.
    monkeypatch.delitem(sys.modules, "toftrack.views.rerun", raising=False)
    monkeypatch.delattr(toftrack.views, "rerun", raising=False)
    with pytest.raises(Exception) as error:
        instantiate(configuration("view=rerun").view, _partial_=True)
    assert "needs the package rerun-sdk" in sentence(error.value)
    assert '"toftrack[rerun]"' in sentence(error.value)


@pytest.fixture(scope="module")
def rerun_view():
    """The module, where rerun-sdk is installed."""
    pytest.importorskip("rerun", reason="rerun-sdk is not installed (pip install -e '.[rerun]')")
    from toftrack.views import rerun as rerun_view

    return rerun_view


@cache
def moments() -> tuple[TrackedFrame, ...]:
    """Six tracked frames; then one without an estimate, and one where nothing is in range."""
    frames = tracked(Sample(stop=FRAMES), make_tracker(*QUICK))
    last = frames[-1].estimates[0]
    nan = dataclasses.replace(last, index=6, timestamp_s=0.24, state=NAN, lost=True)
    gone = dataclasses.replace(last, index=7, timestamp_s=0.28, lost=True, score=0.0)
    without = with_hand(frames[-1], estimate=gone, insight=None)
    return *frames, with_hand(frames[-1], estimate=nan), without


@pytest.fixture(scope="module")
def written(rerun_view, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rerun")
    with rerun_view.RerunView(folder, 25.0, 8, likelihood=f_measure()) as view:
        for moment in moments():
            view.show(moment)
        assert view.commands() == ()
    return folder / "track.rrd"


def rows(path: Path, entity: str, component: str) -> dict[int, np.ndarray]:
    """What is logged of a component, by frame number, as flat arrays; {} where it was cleared."""
    chunk = pytest.importorskip("rerun.chunk", reason="this rerun-sdk reads files in another way")
    found: dict[int, np.ndarray] = {}
    for part in chunk.RrdReader(path).stream().to_chunks():
        batch = part.to_record_batch()
        if part.entity_path != f"/{entity}" or component not in batch.schema.names:
            continue
        assert {"frame", "time"} <= set(batch.schema.names)
        numbers = batch.column("frame").to_pylist()
        times = batch.column("time").to_pylist()
        for number, when, value in zip(numbers, times, batch.column(component), strict=True):
            assert when.total_seconds() == pytest.approx(number / 25)
            if value.is_valid:
                found[number] = np.asarray(value.values.to_pylist())
    return found


def test_the_file_passes_reruns_own_check(written: Path) -> None:
    check = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", str(written)],
        capture_output=True,
        text=True,
    )
    assert check.returncode == 0 and "without error" in check.stdout + check.stderr


def test_every_frames_estimate_can_be_read_back(written: Path) -> None:
    joints = rows(written, "world/hand/joints", "Points3D:positions")
    assert sorted(joints) == [0, 1, 2, 3, 4, 5, 7]  # frame 6 has no estimate
    plots = {
        name: rows(written, f"plots/{name}", "Scalars:scalars")
        for name in ("score", "latent", "pinch", "time")
    }
    for estimate in (moment.estimates[0] for moment in moments()):
        number = estimate.index
        for name, values in {
            "score": [estimate.score, estimate.confidence, float(estimate.lost)],
            "latent": estimate.latent,
            "pinch": [estimate.pinch],
            "time": [1e3 * estimate.compute_s],
        }.items():
            assert plots[name][number] == pytest.approx(values, nan_ok=True), name
        if number != 6:
            np.testing.assert_allclose(joints[number], estimate.joints_m, atol=1e-6)
    colours = rows(written, "world/hand/ellipsoids", "Ellipsoids3D:colors")
    assert len(set(colours[5].tolist())) == 6  # five fingers and the palm
    assert len(colours[7]) == 1  # one colour says that it is lost


def test_depth_comes_back_in_metres_and_with_its_pinhole(written: Path) -> None:
    steps = rows(written, "world/camera/depth", "DepthImage:buffer")
    metre = rows(written, "world/camera/depth", "DepthImage:meter")
    for moment in moments():
        number = moment.estimates[0].index
        depth = steps[number].reshape(-1).astype(np.uint8).view(np.uint16) / metre[number]
        np.testing.assert_allclose(depth.reshape(144, 176), moment.depth_m, atol=1.1e-4)
    pinhole = rows(written, "world/camera", "Pinhole:image_from_camera")
    assert list(pinhole) == [0]  # it does not change
    np.testing.assert_allclose(pinhole[0].reshape(3, 3).T, moments()[0].camera.K)


def test_classified_pixels_are_those_of_the_figures(written: Path) -> None:
    labels = rows(written, "world/tracker/classified", "SegmentationImage:buffer")
    segments = rows(written, "world/tracker/segmentation", "SegmentationImage:buffer")
    for moment in (frame.hands[0] for frame in moments()[:FRAMES]):
        seen = moment.insight.observation
        _, pixels = classify(moment.estimate.state, moment.shape, seen, f_measure())
        np.testing.assert_array_equal(labels[moment.estimate.index].reshape(144, 176), pixels)
        hand = segments[moment.estimate.index].reshape(144, 176) == 1
        np.testing.assert_array_equal(hand, seen.hand.numpy())
    assert not labels[6].any()
    assert 7 not in labels and 7 not in segments  # nothing in range: cleared


def test_the_second_hand_has_entities_of_its_own(rerun_view, tmp_path: Path) -> None:
    both = two_hands(moments()[5])
    with rerun_view.RerunView(tmp_path, 25.0, 2, likelihood=f_measure()) as view:
        view.show(both)
        view.show(two_hands(moments()[7], lost=True, state=NAN))
    path = tmp_path / "track.rrd"
    joints = rows(path, "world/hand_2/joints", "Points3D:positions")
    np.testing.assert_allclose(joints[5], both.estimates[1].joints_m, atol=1e-6)
    assert list(joints) == [5]
    labels = rows(path, "world/hand_2/label", "Points3D:labels")
    assert {number: words.tolist() for number, words in labels.items()} == {5: ["left"]}
    scores = rows(path, "plots/score/hand_2", "Scalars:scalars")
    assert scores[5][0] == pytest.approx(both.estimates[1].score)
    assert sorted(rows(path, "world/hand/joints", "Points3D:positions")) == [5, 7]


def test_a_folder_that_cannot_be_written_is_reported(rerun_view, tmp_path: Path) -> None:
    view = rerun_view.RerunView(tmp_path / "nowhere" / "deep", 25.0, likelihood=f_measure())
    with pytest.raises(ToftrackError, match="track.rrd' cannot be written"):
        view.show(moments()[0])
    view.close()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"connect": "http://127.0.0.1:9876"}, "no address of a viewer"),
        ({"connect": "rerun+http://127.0.0.1:FREE/proxy"}, "no viewer answers"),
        ({"connect": "x", "spawn": True}, "exclude each other"),
    ],
)
def test_addresses_without_a_viewer_are_reported(rerun_view, tmp_path, settings, words) -> None:
    settings["connect"] = settings["connect"].replace("FREE", str(free_port()))
    with pytest.raises(ToftrackError, match=words):
        rerun_view.RerunView(tmp_path, 25.0, likelihood=f_measure(), **settings)


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_viewer_is_sent_the_same(rerun_view, tmp_path: Path) -> None:
    port = free_port()
    received = tmp_path / "received.rrd"
    # Rerun's own server, which keeps what it receives instead of showing it.
    server = subprocess.Popen(
        [sys.executable, "-m", "rerun", "--save", str(received)]
        + ["--port", str(port), "--bind", "127.0.0.1"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        for _ in range(100):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        address = f"rerun+http://127.0.0.1:{port}/proxy"
        view = rerun_view.RerunView(tmp_path, 25.0, 8, likelihood=f_measure(), connect=address)
        for moment in moments():
            view.show(moment)
        view.close()
        view.close()  # a second time does nothing
        size = -1
        while size != (size := received.stat().st_size):
            time.sleep(0.5)
    finally:
        os.killpg(server.pid, signal.SIGTERM)  # python's, and the program's that it started
        server.wait(10)
    assert not (tmp_path / "track.rrd").exists()
    joints = rows(received, "world/hand/joints", "Points3D:positions")
    assert sorted(joints) == [0, 1, 2, 3, 4, 5, 7]


def test_a_viewer_that_takes_nothing_does_not_hold_up_the_tracker(
    rerun_view, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    stuck = threading.Event()
    unregistered: list[bool] = []
    monkeypatch.setattr(rerun_view, "_ANSWER_S", 0.2)
    monkeypatch.setattr(rerun_view, "_require_answer", lambda address: None)
    monkeypatch.setattr(rerun_view.rr, "unregister_shutdown", lambda: unregistered.append(True))
    monkeypatch.setattr(rerun_view.rr.RecordingStream, "connect_grpc", lambda *a, **k: None)
    view = rerun_view.RerunView(tmp_path, 25.0, likelihood=f_measure(), connect="rerun+http://a")
    monkeypatch.setattr(view._entities, "log", lambda moment: stuck.wait())
    for _ in range(50):
        view.show(moments()[0])
    with pytest.raises(ToftrackError, match="takes nothing any more.*result files are whole"):
        view.close()
    assert unregistered and "too slow for" in caplog.text
    stuck.set()
    view._thread.join(10)


def test_a_failure_in_the_thread_is_raised_where_the_frame_was_shown(
    rerun_view, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(moment: TrackedFrame) -> None:
        raise RuntimeError("no space")

    view = rerun_view.RerunView(tmp_path, 25.0, likelihood=f_measure())
    monkeypatch.setattr(view._entities, "log", fail)
    with pytest.raises(ToftrackError, match="track.rrd' cannot be written"):
        for _ in range(100):
            view.show(moments()[0])
            time.sleep(0.01)
    with pytest.raises(ToftrackError, match="cannot be written"):
        view.close()
    assert not view._thread.is_alive()
