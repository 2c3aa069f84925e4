"""Devices: the frames of a recording, in order, as they were recorded."""

import itertools
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toftrack.devices.live import SdkCamera
from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera

T, H, W = 12, 6, 8
K = np.array([[20.0, 0, 4], [0, 20.0, 3], [0, 0, 1]])


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "recording.npz"
    depth = np.arange(1, T + 1, dtype=np.float16)[:, None, None] / 16 * np.ones((1, H, W))
    np.savez(
        path,
        depth_m=depth.astype(np.float16),
        amplitude=np.arange(T, dtype=np.uint16)[:, None, None] * np.ones((1, H, W), np.uint16),
        K=K,
        fps=100.0,
        joints_m=np.arange(T)[:, None, None] * np.ones((1, 21, 3)),
        visible=np.arange(T) % 2 == 0,
        in_space=np.arange(T) % 3 == 0,
        metadata='{"who": "a test"}',
    )
    return path


class Depthless(SdkCamera):
    """An SDK's recording whose sets of frames have no depth."""

    kind = maker = "depthless"

    def __init__(self, bag: Path) -> None:
        self._begin(bag, "every", 2, start=0, stop=None, timeout_s=0.05)
        self._set_up((W, H), 30.0, False, None, lambda: Camera(K, W, H))
        self._sets = 3
        self._pipeline = self

    def _run(self) -> None: ...
    def stop(self) -> None: ...
    def get_depth_frame(self) -> None: ...

    def _take(self) -> "Depthless | None":
        self._sets -= 1
        return self if self._sets >= 0 else None

    def _over(self) -> bool:
        return True

    def _plugged_in(self) -> bool:
        return True

    def _number(self, depth: Any) -> int:
        raise AssertionError

    def _frame(self, came: Any, depth: Any, index: int) -> Any:
        raise AssertionError


def test_a_recording_of_an_sdk_without_depth_says_so(tmp_path: Path) -> None:
    (tmp_path / "colour.bag").touch()
    with pytest.raises(ToftrackError, match="colour.bag' has no frame with depth; record it again"):
        list(Depthless(tmp_path / "colour.bag"))


def test_iterating_again_starts_again_and_a_frame_is_the_callers_own(recording: Path) -> None:
    device = Replay(recording, stop=3)
    for _ in range(2):
        frames = list(device)
        assert [frame.index for frame in frames] == [0, 1, 2]
        for number, frame in enumerate(frames):
            assert frame.depth.dtype == np.float32 and (frame.depth == (number + 1) / 16).all()
            assert frame.amplitude.dtype == np.uint16 and (frame.amplitude == number).all()
            frame.depth[:] = -1


def test_range_keeps_the_recordings_indices_and_its_truth(recording: Path) -> None:
    device = Replay(recording, start=4, stop=7)
    assert [frame.index for frame in device] == [4, 5, 6]
    assert device.frames == len(device.truth) == 3
    assert device.truth.joints_m[:, 0, 0].tolist() == [4, 5, 6]
    assert device.truth.visible.tolist() == [True, False, True]
    assert device.truth.in_space.tolist() == [False, False, True]
    assert device.truth.visible_fraction is None
    description = json.loads(json.dumps(device.description))
    assert description["recording"] == str(recording)
    assert (description["start"], description["stop"]) == (4, 7)
    assert device.metadata == {"who": "a test"}


@pytest.mark.parametrize(
    ("start", "stop"),
    [(T, None), (-1, None), (0, T + 1), (5, 5)],
)
def test_range_outside_the_recording_is_reported(recording: Path, start: Any, stop: Any) -> None:
    with pytest.raises(ToftrackError, match=f"start=.*stop=.*<= {T}"):
        Replay(recording, start=start, stop=stop)
    with pytest.raises(ToftrackError, match="start=a is not possible"):
        Replay(recording, start="a", stop=stop)


def test_a_recording_that_repeats_goes_on_in_number_and_time(recording: Path) -> None:
    frames = list(itertools.islice(Replay(recording, repeat=True), 2 * T + 1))
    assert [frame.index for frame in frames] == list(range(2 * T + 1))
    assert np.diff([frame.timestamp_s for frame in frames]) == pytest.approx(0.01)
    assert np.array_equal(frames[-1].depth, frames[0].depth)


def test_realtime_drops_what_comes_too_late(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(time, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    device = Replay(recording, start=1, realtime=True)
    assert device.live
    indices = []
    for frame in device:
        indices.append(frame.index)
        now[0] += 0.035  # three and a half frames
    assert indices == [1, 2, 5, 9, 11], "what is loaded for the first one is waited for"
    assert device.dropped == 6
    assert [frame.index for frame in device] == list(range(1, T)), "nothing is late this time"
    assert device.dropped == 0
