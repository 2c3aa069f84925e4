"""Frames of any device become a recording, which grows as they come and is never lost."""

from __future__ import annotations

import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from toftrack.devices.base import BaseDevice
from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.frames.frame import Frame
from toftrack.recordings import recorder as module
from toftrack.recordings.doubts import times_doubt
from toftrack.recordings.npz import read_recording
from toftrack.recordings.recorder import Recorder
from toftrack.recordings.unfinished import recover_recording

HEIGHT, WIDTH, FRAMES = 24, 32, 6
UNIT_M = 0.00025
K = np.array([[40.0, 0, 15.5], [0, 41.0, 11.5], [0, 0, 1]])


def words(number: int) -> np.ndarray:
    """What a camera measured, in steps of its unit."""
    generator = np.random.default_rng(number)
    return generator.integers(0, 2**14, (HEIGHT, WIDTH)).astype(np.uint16)


class Images(BaseDevice):
    """Images of noise, which compress badly."""

    def __init__(self, camera: Camera | None = None, radial: bool = False) -> None:
        super().__init__(camera or Camera(K, WIDTH, HEIGHT), 30.0)
        self.description |= {"serial": "1234", "recording": "/home/me/hand.bag", "size": [1, 2]}
        self.description["files"] = ["depth_1.png"]
        self.metadata = {"hand_length_mm": 180.5}
        self._radial = radial

    def __iter__(self) -> Iterator[Frame]:
        for number in range(FRAMES):
            depth = words(number).astype(np.float32) * np.float32(UNIT_M)
            depth[0, :3] = np.nan, np.inf, -1
            amplitude = words(100 + number)
            yield Frame(2 * number, 1e9 + number / 30.1, depth, amplitude, self._radial)


def recorded(
    path: Path, *frames: Frame, limit_gb: float = 1.0, overwrite: bool = False
) -> Recorder:
    device = Images()
    with closing(Recorder(path, device, limit_gb, overwrite)) as recorder:
        for frame in frames or device:
            recorder.put(frame, wait=True)
    return recorder


def one_frame(**changes: object) -> Frame:
    return replace(next(iter(Images())), **changes)


CAMERAS = {
    "plain": Camera(K, WIDTH, HEIGHT),
    "rational": Camera(K, WIDTH, HEIGHT, np.linspace(0.01, 0.08, 8)),
    "fisheye": Camera(K, WIDTH, HEIGHT, np.linspace(0.01, 0.04, 4), lens="fisheye"),
    "calibrated": Camera(
        K, WIDTH, HEIGHT, depth_polynomial=(0.01, 0.1), depth_polynomial_range_m=(0.3, 1.5)
    ),
}


@pytest.mark.parametrize("lens", CAMERAS)
def test_a_recording_holds_exactly_what_came(tmp_path: Path, lens: str) -> None:
    radial = lens in ("plain", "calibrated")
    device, path = Images(CAMERAS[lens], radial), tmp_path / "hand.npz"
    with closing(Recorder(path, device, 1.0)) as recorder:
        for frame in device:
            recorder.put(frame, wait=True)
            frame.depth[:] = 7  # a camera that uses its memory again
    assert recorder.ended is None and not recorder.failed
    recording = read_recording(path)
    assert (len(recording), recording.radial) == (FRAMES, radial)
    assert recording.camera.to_dict() == device.camera.to_dict()
    for number, frame in enumerate(device):
        depth, amplitude = recording.image(number)
        assert depth.tobytes() == frame.depth.tobytes()
        steps = depth[1:].astype(np.float64) / UNIT_M
        np.testing.assert_array_equal(np.rint(steps), words(number)[1:])
        np.testing.assert_array_equal(amplitude, frame.amplitude)
        assert recording.timestamp_s[number] == frame.timestamp_s
    assert recording.metadata["hand_length_mm"] == 180.5
    assert recording.metadata["recorded"]["device"] == {
        "device": "Images",
        "recording": "hand.bag",
        "size": [1, 2],
    }
    with np.load(path) as archive:  # whose index has gaps where frames were dropped
        np.testing.assert_array_equal(archive["index"], 2 * np.arange(FRAMES))
    assert [file.name for file in tmp_path.iterdir()] == ["hand.npz"]


def unfinished(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What a recorder that was killed before it could finish leaves."""

    def killed(*arguments: object) -> None:
        raise ToftrackError("killed")

    with monkeypatch.context() as patch:
        patch.setattr(module, "finish", killed)
        recorded(folder / "hand.npz")
    return folder / "hand.npz.part"


def whole_frames(content: bytes, until: int) -> int:
    """Frames of an unfinished recording that end before a byte."""
    begins = [match.start() for match in re.finditer(b"TOFR", content)]
    assert len(begins) == FRAMES
    return sum(end <= until for end in [*begins[1:], len(content)])


@pytest.mark.parametrize("damaged", [False, True])
@pytest.mark.parametrize("share", [0.3, 0.55, 0.98, 1.0])
def test_what_was_whole_is_recovered_wherever_it_was_cut_off_or_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float, damaged: bool
) -> None:
    part = unfinished(tmp_path, monkeypatch)
    content = bytearray(part.read_bytes())
    at = int(share * len(content)) - damaged
    expected = whole_frames(content, at)
    if damaged:
        content[at] ^= 1
    part.write_bytes(content if damaged else content[:at])
    path, count = recover_recording(part if damaged else tmp_path / "hand.npz")
    assert (path, count) == (tmp_path / "hand.npz", expected)
    recording = read_recording(path)
    assert len(recording) == count >= 1
    for number, frame in zip(range(count), Images(), strict=False):
        assert recording.image(number)[0].tobytes() == frame.depth.tobytes()
        np.testing.assert_array_equal(recording.image(number)[1], frame.amplitude)
    assert not part.exists()


@pytest.mark.parametrize("content", [b"", b"something else", None])
def test_what_is_no_unfinished_recording_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes | None
) -> None:
    part = unfinished(tmp_path, monkeypatch)
    content = part.read_bytes()[:60] if content is None else content
    part.write_bytes(content)
    with pytest.raises(ToftrackError, match="no unfinished recording|ends before its first frame"):
        recover_recording(tmp_path / "hand.npz")
    assert part.read_bytes() == content
    assert not (tmp_path / "hand.npz").exists()
    with pytest.raises(ToftrackError, match="nothing to recover"):
        recover_recording(tmp_path / "other.npz")


def test_a_recording_that_goes_on_is_not_recovered(tmp_path: Path) -> None:
    pytest.importorskip("fcntl")
    with closing(Recorder(tmp_path / "hand.npz", Images(), 1.0)):
        with pytest.raises(ToftrackError, match="being recorded just now"):
            recover_recording(tmp_path / "hand.npz")
        with pytest.raises(ToftrackError, match="being recorded just now"):
            Recorder(tmp_path / "hand.npz", Images(), 1.0, overwrite=True)


def test_what_is_there_is_not_replaced_unless_it_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "hand.npz"
    path.write_text("mine")
    with pytest.raises(ToftrackError, match="exists already"):
        recorded(path)
    (tmp_path / "other").mkdir()
    part = unfinished(tmp_path / "other", monkeypatch).rename(tmp_path / "hand.npz.part")
    with pytest.raises(ToftrackError, match="exists already"):
        recover_recording(path)
    assert path.read_text() == "mine"
    path.unlink()
    with pytest.raises(ToftrackError, match="toftrack recover .*finishes it"):
        recorded(path)
    assert part.exists()
    path.write_text("mine")
    assert recorded(path, overwrite=True).frames == FRAMES
    assert len(read_recording(path)) == FRAMES


def test_nothing_is_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "hand.npz.part").symlink_to(tmp_path / "mine")
    for overwrite in (False, True):
        with pytest.raises(ToftrackError, match="link|exists already"):
            recorded(tmp_path / "hand.npz", overwrite=overwrite)
    with pytest.raises(ToftrackError, match="link"):
        recover_recording(tmp_path / "hand.npz")
    assert (tmp_path / "mine").read_text() == "mine"
    assert (tmp_path / "hand.npz.part").is_symlink()


@pytest.mark.parametrize(
    ("limit_gb", "free", "why"),
    [(8e-6, 10**12, "its limit, 8e-06 GB"), (1.0, 6000, "the disk is nearly full")],
)
def test_at_its_limit_and_before_the_disk_is_full_it_ends_as_a_whole_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit_gb: float, free: int, why: str
) -> None:
    usage = SimpleNamespace(free=module._SPARE_BYTES + free)
    fake = SimpleNamespace(disk_usage=lambda path: usage)
    monkeypatch.setattr("toftrack.recordings.recorder.shutil", fake)
    recorder = recorded(tmp_path / "hand.npz", limit_gb=limit_gb)
    assert 1 <= recorder.frames < FRAMES and not recorder.failed
    assert why in (recorder.ended or "")
    assert len(read_recording(tmp_path / "hand.npz")) == recorder.frames


def test_on_a_full_disk_the_frames_until_then_are_kept(tmp_path: Path, files_of_at_most) -> None:
    with files_of_at_most(9_000):  # some frames
        recorder = recorded(tmp_path / "hand.npz")
    count, ended = recorder.frames, recorder.ended or ""
    assert recorder.failed and 1 < count < FRAMES
    assert "which is kept (" in ended and "\n" not in ended
    assert "make room, then `toftrack recover" in ended
    assert [file.name for file in tmp_path.iterdir()] == ["hand.npz.part"]
    recording = read_recording(recover_recording(tmp_path / "hand.npz")[0])
    assert len(recording) == count
    for number, frame in zip(range(count), Images(), strict=False):
        assert recording.image(number)[0].tobytes() == frame.depth.tobytes()


@pytest.mark.parametrize(
    ("go", "folder"), [(Path.unlink, "."), (lambda part: shutil.rmtree(part.parent), "deep")]
)
def test_what_is_removed_while_it_grows_is_one_sentence_and_nobody_waits(
    tmp_path: Path, go: Callable[[Path], object], folder: str
) -> None:
    path = tmp_path / folder / "hand.npz"
    path.parent.mkdir(exist_ok=True)
    with closing(Recorder(path, Images(), 1.0)) as recorder:
        recorder.put(one_frame(), wait=True)
        while not recorder.frames:
            time.sleep(0.001)
        go(path.with_name("hand.npz.part"))
        for _ in range(2 * module._WAITING):  # more than would wait
            recorder.put(one_frame(), wait=True)
    assert recorder.failed and not path.exists() and recorder.words() == ""
    assert "was removed or renamed while the recording grew" in (recorder.ended or "")


def test_times_never_go_back_nor_leap(tmp_path: Path) -> None:
    # A RealSense's may leap: its first frames by its own clock, the others by the host's.
    times = [5.0, 5.1, 2.0, 2.1, np.nan, 2.3, 1.7e9, 1.7e9 + 40]
    recorded(tmp_path / "hand.npz", *(one_frame(timestamp_s=time) for time in times))
    step = 1 / 30
    expected = [5.0, 5.1, 5.1 + step, 5.2 + step, 5.2 + 2 * step, 5.4 + step]
    expected += [5.4 + 2 * step, 45.4 + 2 * step]
    np.testing.assert_allclose(read_recording(tmp_path / "hand.npz").timestamp_s, expected)


def test_times_in_another_unit_stay_as_they_are_to_be_told(tmp_path: Path) -> None:
    times = 5e6 + 33_333.0 * np.arange(5)  # microseconds: each step would be a leap
    recorded(tmp_path / "hand.npz", *(one_frame(timestamp_s=time) for time in times))
    found = read_recording(tmp_path / "hand.npz").timestamp_s
    np.testing.assert_allclose(np.diff(found)[1:], 33_333.0)
    assert "microseconds" in times_doubt(found)


def test_another_unit_is_reported_at_the_beginning(tmp_path: Path) -> None:
    for name, depth in (("a", words(0)), ("b", words(0).astype(np.float32))):
        frames = [one_frame(depth=depth)] * module._STRANGE
        recorder = recorded(tmp_path / f"{name}.npz", *frames)
        assert recorder.failed and "plainly millimetres" in (recorder.ended or "")
    good = [one_frame(), *frames]  # a camera may begin with nonsense, and have some later
    assert not recorded(tmp_path / "c.npz", *good).failed
    assert not recorded(tmp_path / "d.npz", *frames[1:], *good).failed


def test_frames_that_do_not_fit_those_before_end_it(tmp_path: Path) -> None:
    small = {"depth": np.ones((HEIGHT, 7), np.float32)}
    for number, other in enumerate((small, {"radial": True}, {"amplitude": np.ones((3, 3))})):
        path = tmp_path / f"{number}.npz"
        recorder = recorded(path, one_frame(), one_frame(**other), one_frame())
        assert recorder.failed and "frame 0" in (recorder.ended or "")
        assert len(read_recording(path)) == 1


def test_without_a_frame_there_is_no_file(tmp_path: Path) -> None:
    with closing(Recorder(tmp_path / "hand.npz", Images(), 1.0)) as recorder:
        pass
    assert recorder.ended is None and recorder.words() == ""
    assert not list(tmp_path.iterdir())


def test_frames_that_wait_while_python_ends_are_recorded(tmp_path: Path) -> None:
    with closing(Recorder(tmp_path / "hand.npz", Images(), 1.0)) as recorder:
        recorder._second.shutdown()  # as Python does at its end
        recorder.put(one_frame(), wait=True)
    assert recorder.ended is None and recorder.frames == 1


@pytest.mark.parametrize(("most_bytes", "waiting"), [(2**28, 32), (1, 2)])
def test_a_live_run_does_not_wait_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most_bytes: int, waiting: int
) -> None:
    monkeypatch.setattr(module, "_WAITING_BYTES", most_bytes)
    held = threading.Event()
    append = module.UnfinishedRecording.append

    def slow(*arguments: object) -> None:
        held.wait()
        append(*arguments)

    monkeypatch.setattr(module.UnfinishedRecording, "append", slow)
    many = 2 * waiting
    with closing(Recorder(tmp_path / "hand.npz", Images(), 1.0)) as recorder:
        for _ in range(many):
            recorder.put(one_frame(), wait=False)
        held.set()
    assert recorder.missed >= many - waiting - 1 > 0
    assert recorder.frames + recorder.missed == many
    assert f"{recorder.missed} more came too fast" in recorder.words()


def test_a_recording_that_could_not_take_its_place_does_not_begin(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "hand.npz").symlink_to(tmp_path / "mine")
    (tmp_path / "folder.npz").mkdir()
    for name in ("hand.npz", "folder.npz"):
        with pytest.raises(ToftrackError, match="choose another place"):
            Recorder(tmp_path / name, Images(), 1.0, overwrite=True)
    assert (tmp_path / "mine").read_text() == "mine" and not list(tmp_path.glob("*.part"))
