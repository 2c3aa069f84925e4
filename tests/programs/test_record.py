"""`toftrack record`, `recover` of its files, and what a run keeps with record=FILE."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.fake_orbbec import DEPTH, IR, Images, Sdk, image, profile
from helpers.fake_orbbec import Camera as FakeCamera
from helpers.programs import QUICK, interrupted_when, killed_when
from helpers.settings import orbbec, realsense, realsense_emulator, sr3000, sr3000_emulator
from helpers.tracking import Camera, run

from toftrack.devices.base import BaseDevice, Device
from toftrack.devices.realsense.device import load_sdk
from toftrack.devices.replay import Replay, Sample
from toftrack.errors import ToftrackError
from toftrack.frames.frame import Frame
from toftrack.programs import command_line, recover
from toftrack.programs.record import main, record_frames
from toftrack.recordings import recorder
from toftrack.recordings.npz import read_recording
from toftrack.recordings.recorder import Recorder

FEW = 5
SR3000 = ("device=sr3000", "device.transport=emulated")
TRACK = ("view=none", "experiment=paper", *QUICK)


def a_realsense(monkeypatch: pytest.MonkeyPatch) -> Device:
    try:
        load_sdk()
    except ToftrackError as error:
        pytest.skip(str(error))
    emulated = realsense_emulator(fps=200.0, unit_m=0.0001)
    return realsense(transport="emulated", keep="every", stop=FEW, emulated=emulated)


def an_orbbec(monkeypatch: pytest.MonkeyPatch) -> Device:
    lens = (0.1, -0.2, 0.05, 0.3, -0.04, 0.01, 0.001, -0.002)
    profiles = {DEPTH: [profile("y16", lens=lens)], IR: [profile("y8")]}
    sets = [Images(image(n), image(n, np.uint8)) for n in (150, 151, 152, 154, 155)]
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", Sdk(FakeCamera("0042", profiles, sets)))
    return orbbec(keep="every", stop=FEW)


def an_sr3000(monkeypatch: pytest.MonkeyPatch) -> Device:
    emulated = sr3000_emulator(fps=200.0)
    return sr3000(transport="emulated", keep="every", stop=FEW, emulated=emulated)


CAMERAS = (a_realsense, an_orbbec, an_sr3000)


class Watched(BaseDevice):
    """A device, and the frames that it gave."""

    def __init__(self, device: Device) -> None:
        super().__init__(device.camera, device.fps, device.frames)
        self.description, self.metadata, self.live = device.description, {}, device.live
        self.device, self.seen = device, []  # type: Device, list[Frame]

    def close(self) -> None:
        self.device.close()

    def __iter__(self) -> Iterator[Frame]:
        for frame in self.device:
            self.seen.append(frame)
            yield frame


@pytest.mark.parametrize("plug", CAMERAS)
def test_what_a_camera_gave_is_replayed(
    plug: Callable[[pytest.MonkeyPatch], Device], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera, path = Watched(plug(monkeypatch)), tmp_path / "hand.npz"
    record_frames(camera, Recorder(path, camera, 1.0))
    replay = Replay(path)
    assert replay.camera.to_dict() == camera.camera.to_dict()
    assert len(camera.seen) == replay.frames >= FEW - 1
    for given, kept in zip(camera.seen, replay, strict=True):
        assert kept.depth.tobytes() == given.depth.tobytes()
        np.testing.assert_array_equal(kept.amplitude, given.amplitude)
        assert (kept.timestamp_s, kept.radial) == (given.timestamp_s, given.radial)
    device = read_recording(path).metadata["recorded"]["device"]
    assert device["device"] == camera.description["device"]
    assert "serial" not in device


def test_a_run_keeps_what_it_saw_and_tracking_that_gives_the_same(tmp_path, monkeypatch) -> None:
    camera, path = an_sr3000(monkeypatch), tmp_path / "kept.npz"
    run(tmp_path / "live", camera, *TRACK, f"record='{path}'")
    run(tmp_path / "again", Replay(path), *TRACK)
    live, again = (np.load(tmp_path / name / "track.npz") for name in ("live", "again"))
    assert live["joints_m"].shape == (FEW, 21, 3)
    for name in ("joints_m", "state", "confidence", "lost", "timestamp_s", "index"):
        np.testing.assert_array_equal(live[name], again[name], err_msg=name)


def test_what_came_before_an_error_is_kept_with_gaps_where_frames_were_dropped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = Camera(FEW, every=2, fails=ToftrackError)
    with pytest.raises(ToftrackError, match="unplugged"):
        run(tmp_path / "run", camera, *TRACK, f"record='{tmp_path}/a.npz'")
    with pytest.raises(ToftrackError, match="unplugged"):
        record_frames(camera, Recorder(tmp_path / "b.npz", camera, 1.0))
    assert f"{tmp_path / 'b.npz'}: {FEW} frames" in capsys.readouterr().out
    for name in ("a.npz", "b.npz"):
        with np.load(tmp_path / name) as kept:
            assert kept["index"].tolist() == list(range(0, 2 * FEW, 2))


def test_a_recording_that_fails_does_not_end_the_run(tmp_path, monkeypatch, caplog) -> None:
    def full(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("toftrack.recordings.unfinished.UnfinishedRecording.append", full)
    run(tmp_path / "run", Sample(stop=FEW), *TRACK, f"record='{tmp_path}/kept.npz'")
    with np.load(tmp_path / "run" / "track.npz") as track:
        assert len(track["lost"]) == FEW
    assert [line for line in caplog.messages if "recording" in line] == [
        f"the recording '{tmp_path / 'kept.npz'}' was not made: No space left on device"
    ]


def test_a_run_whose_recording_exists_does_not_begin(tmp_path: Path) -> None:
    (tmp_path / "kept.npz").write_text("mine")
    with pytest.raises(ToftrackError, match="exists already"):
        run(tmp_path / "run", Sample(stop=FEW), *TRACK, f"record='{tmp_path}/kept.npz'")
    assert (tmp_path / "kept.npz").read_text() == "mine"
    assert not (tmp_path / "run").exists()


def record(*arguments: str) -> int:
    return command_line.run(lambda: main(arguments))


def test_the_command_records_a_camera_of_ones_own(tmp_path, monkeypatch) -> None:
    (tmp_path / "my_conf" / "device").mkdir(parents=True)
    settings = "_target_: mine.Mine\nframes: ???\n"
    (tmp_path / "my_conf" / "device" / "mine.yaml").write_text(settings)
    code = "from toftrack.devices.synthetic import Synthetic as Mine\n"
    (tmp_path / "mine.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    given = ("--config-dir", "my_conf", "device=mine", "hand.npz", "device.frames=4")
    assert record(*given) == 0
    assert len(read_recording("hand.npz")) == 4
    assert record(*given, "--frames", "3") == 1  # it exists
    assert record(*given, "--frames", "3", "--overwrite") == 0
    assert len(read_recording("hand.npz")) == 3


def test_at_the_limit_the_command_ends_well(tmp_path, capsys) -> None:
    for path in (tmp_path / "a.npz", tmp_path / "a.srs"):
        assert record(str(path), *SR3000, "device.emulated.fps=200", "--limit", "0.0004") == 0
        reported = capsys.readouterr()
        assert "its limit, 0.0004 GB" in reported.err
        assert f"{path}: " in reported.out
        assert 0.0004e9 <= path.stat().st_size < 0.0008e9
        assert Replay(path).frames > 2


def test_who_says_how_many_frames_gets_them(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(recorder, "_GIGABYTE", 1e5)  # the default is reached by the second frame
    path = tmp_path / "a.npz"
    nine = (str(path), *SR3000, "device.emulated.fps=200", "--frames", "9")
    assert record(*nine) == 0
    assert Replay(path).frames == 9
    assert record(*nine, "++record_limit_gb=1", "--overwrite") == 0
    assert Replay(path).frames < 9


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["a.npz"], "which camera is it? Give device="),
        (["a.avi"], "is recorded to .npz"),
        (["a.srs", "device=sample"], "only an SR3000"),
        (["a.npz", "device=synthetic", "--limit", "0"], "--limit=0.0 is not possible"),
        (["a.npz", "device=synthetic", "--config-dir", "nowhere"], "no folder 'nowhere'"),
        (["a.npz", "device=replay"], "device.path"),
        (["nowhere/a.npz", "device=synthetic"], "No such file or directory"),
    ],
)
def test_its_errors_are_one_sentence(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert record(*arguments) == 1
    reported = capsys.readouterr().err
    assert words in reported
    assert reported.startswith("error: ") and reported.count("\n") == 1
    assert not list(tmp_path.iterdir())


def sized(path: Path, least: int) -> bool:
    return path.exists() and path.stat().st_size > least


def test_ctrl_c_leaves_a_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "hand.npz"
    with interrupted_when(lambda: sized(tmp_path / "hand.npz.part", 200_000)):
        assert record(str(path), *SR3000, "device.emulated.loop=true") == 130
    assert len(read_recording(path)) > 2
    assert [file.name for file in tmp_path.iterdir()] == ["hand.npz"]


def test_after_kill_9_the_frames_until_then_are_recovered(tmp_path, capsys) -> None:
    path, part = tmp_path / "hand.npz", tmp_path / "hand.npz.part"
    endless = ("device.emulated.fps=200", "device.emulated.loop=true")
    killed_when(lambda: sized(part, 2_000_000), "record", str(path), *SR3000, *endless)
    size = part.stat().st_size
    recover.main([str(path)])
    replay = Replay(path)
    assert capsys.readouterr().out == f"{path}: {replay.frames} frames\n"
    assert replay.frames >= size // 120_000  # none of the frames takes more
    emulated = sr3000(transport="emulated", keep="every", emulated=sr3000_emulator(fps=500.0))
    first = list(emulated)
    for frame in replay:
        expected = first[frame.index % len(first)]
        np.testing.assert_array_equal(frame.depth, expected.depth)
        np.testing.assert_array_equal(frame.amplitude, expected.amplitude)
