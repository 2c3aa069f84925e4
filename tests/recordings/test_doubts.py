"""What looks wrong in a recording is said with the value that would fit; what is right is not."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from toftrack.api import make_device, make_hands_tracker
from toftrack.devices.replay import Folder, Replay
from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.frames.frame import checked_image
from toftrack.output.advice import Watch
from toftrack.output.summary import apparent_doubt, length_doubt
from toftrack.recordings.doubts import (
    centre_doubt,
    gaps_doubt,
    lens_doubt,
    names_doubt,
    times_doubt,
)
from toftrack.recordings.npz import read_recording

K = np.array([[200.0, 0, 88], [0, 200, 72], [0, 0, 1]])
TIMES = np.array([0, 0.033, 0.067, 0.1, 0.133, 0.5])
DATA = Path(__file__).parents[3] / "shared" / "data"
FOLDERS = ("crowd", "grasps", "mesh-hand", "real")


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1e3, "look like milliseconds: their median step is 33; divide them by 1000,"),
        (1e6, "look like microseconds: their median step is 33000; divide them by 1000000,"),
        (1e9, "look like nanoseconds"),
        (1e-3, "look like thousands of seconds: their median step is 3.3e-05; multiply them by"),
    ],
)
def test_times_in_another_unit_are_reported_with_the_factor(factor: float, words: str) -> None:
    assert words in times_doubt(TIMES * factor + 17)


def test_times_that_stand_still_are_reported() -> None:
    assert "all time stamps are 3" in times_doubt(np.full(5, 3.0))
    whole_seconds = np.floor(np.arange(60) / 25)
    assert "57 of 60 time stamps repeat the one before" in times_doubt(whole_seconds)


@pytest.mark.parametrize(
    "times",
    [TIMES, TIMES + 1.7e9, np.arange(9) / 300, np.arange(9.0), np.zeros(1), [0, 0, 0.1, 0.1, 0.2]],
)
def test_times_of_cameras_are_not_doubted(times: np.ndarray) -> None:
    assert times_doubt(np.asarray(times)) == ""


def test_gaps_in_time_are_counted_with_the_first() -> None:
    words = "1 of 5 steps in time are longer than 1.5 times the usual 0.033 s, the first, of 0.367"
    assert words in gaps_doubt(TIMES) and "s, after frame 4;" in gaps_doubt(TIMES)
    for whole in (TIMES[:5], TIMES[:1], np.zeros(4)):
        assert gaps_doubt(whole) == ""


@pytest.mark.parametrize(
    ("distortion", "words"),
    [
        ([8.0, 3, 0, 0, 0], "zeros would leave 100 %"),
        ([-8.0, 0, 0, 0, 0], "zeros would leave 100 %"),
        ([0.1, -0.3, 0.8, 0, 0], "if they were given as k1 k2 k3 p1 p2, would leave"),
    ],
)
def test_a_lens_that_leaves_little_of_the_image_is_reported(distortion: list, words: str) -> None:
    doubt = lens_doubt(Camera(K, 176, 144, distortion))
    assert doubt.startswith("of the image only ") and words in doubt


@pytest.mark.parametrize(
    ("distortion", "lens"),
    [
        ([0.09, -0.27, 0, 0, 0.09], "opencv"),
        ([-0.3, 0.1, 0.001, 0, 0], "opencv"),
        ([0.1, -0.01, 0.01, 0.002], "fisheye"),
    ],
)
def test_lenses_of_cameras_are_not_doubted(distortion: list, lens: str) -> None:
    assert lens_doubt(Camera(K, 176, 144, distortion, lens=lens)) == ""


@pytest.mark.parametrize(
    ("centre", "words"),
    [
        ((88, 72), ""),
        ((70, 80), ""),
        ((176, 144), "its centre at 176, 144, as images of about 352x288 pixels have"),
        ((44, 36), "images of about 88x72 pixels have, but these have 176x144"),
        ((88, -20), "unless they are a part of larger ones"),
    ],
)
def test_the_centre_of_another_resolution_is_reported(centre: tuple, words: str) -> None:
    doubt = centre_doubt(Camera([[200, 0, centre[0]], [0, 200, centre[1]], [0, 0, 1]], 176, 144))
    assert words in doubt and bool(doubt) == bool(words)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ("depth_{:04}.png 1 2 3 7 8 10", "names leave out 4 (4-6, 9), but"),
        ("{}.png 0 2 3", "leave out 1 (1), but"),
        ("s2/depth_{}_v1.png 10 20 50", "leave out 2 (30-40), but"),
        (
            f"{{}}.png 0 1 {' '.join(map(str, range(3, 27, 2)))}",
            "(2, 4, 6, 8, 10, 12, 14, 16, 18, 20, ...)",
        ),
        ("depth_{:04}.png 3 4 5", ""),
        ("{}.png 0 5 10 15", ""),  # every fifth was kept
        ("{}.png 1700000033 1700000066 1700000100 1700000133", ""),  # milliseconds
        ("{}.png 4", ""),
        ("{} ", ""),
    ],
)
def test_numbers_missing_in_names_are_reported(names: str, words: str) -> None:
    name, *numbers = names.split()
    doubt = names_doubt([name.format(int(number)) for number in numbers])
    assert words in doubt and bool(doubt) == bool(words)


def test_a_folder_with_missing_numbers_is_doubted_until_it_has_times(tmp_path: Path) -> None:
    with make_device("device=sample", "device.stop=3") as sample:
        for frame, number in zip(sample, (1, 2, 5), strict=True):
            image = (1000 * frame.depth).astype(np.uint16)
            cv2.imwrite(str(tmp_path / f"depth_{number}.png"), image)
    folder = Folder(tmp_path, intrinsics=[200, 200, 88, 72])
    assert folder.description["files"] == ["depth_1.png", "depth_2.png", "depth_5.png"]
    assert "leave out 2 (3-4)" in folder.description["doubts"][0]
    (tmp_path / "timestamps.txt").write_text("0.04\n0.08\n0.12\n")
    assert Folder(tmp_path, intrinsics=[200, 200, 88, 72]).description["doubts"] == []


@pytest.mark.parametrize("kind", [np.float32, np.uint16])
def test_centimetres_are_not_called_millimetres(kind: type, tmp_path: Path) -> None:
    with make_device("device=sample", "device.stop=2") as sample:
        depth = np.stack([frame.depth for frame in sample])
    path = tmp_path / "cm.npz"
    np.savez(path, depth_m=(100 * depth).astype(kind), K=K)
    with pytest.raises(ToftrackError, match=r"plainly centimetres.*float32'\) / 100$"):
        read_recording(path)
    with pytest.raises(ToftrackError, match="plainly centimetres"):
        checked_image((100 * depth[0]).astype(kind), K)
    np.savez(path, depth_m=(1000 * depth).astype(kind), K=K)
    with pytest.raises(ToftrackError, match=r"plainly millimetres.*float32'\) / 1000$"):
        read_recording(path)


@pytest.mark.parametrize(("step_mm", "right"), [(10, "0.01 m a step"), (0.1, "0.0001 m a step")])
def test_a_folder_in_another_unit_is_reported(step_mm: float, right: str, tmp_path: Path) -> None:
    with make_device("device=sample", "device.stop=1") as sample:
        depth_mm = 1000 * next(iter(sample)).depth
    cv2.imwrite(str(tmp_path / "0.png"), (depth_mm / step_mm).astype(np.uint16))
    given = {"intrinsics": [200, 200, 88, 72]}
    (doubt,) = Folder(tmp_path, **given).description["doubts"]
    assert right in doubt and "device.unit_m" in doubt
    assert not Folder(tmp_path, unit_m=step_mm / 1000, **given).description["doubts"]


def test_doubts_reach_the_log_and_whoever_asks_the_device(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "recording.npz"
    depth = np.random.default_rng(0).uniform(0.4, 1.5, (6, 144, 176)).astype(np.float32)
    lens = np.array([8.0, 3, 0, 0, 0])
    np.savez(path, depth_m=depth, K=K, timestamp_s=TIMES * 1e6, distortion=lens)
    times, distortion = Replay(path).description["doubts"]
    assert "microseconds" in times and "zeros would" in distortion
    assert [message.split(": ", 1)[1] for message in caplog.messages] == [times, distortion]
    caplog.clear()
    with make_device("device=sample") as sample:
        assert sample.description["doubts"] == [] and not caplog.messages


@pytest.mark.slow
@pytest.mark.parametrize("folder", FOLDERS)
def test_no_recording_at_hand_is_doubted(folder: str) -> None:
    """Of those that lie beside the checkout; of others nothing can be said here."""
    for path in sorted((DATA / folder).glob("*.npz")):
        device = Replay(path)
        assert device.description["doubts"] == [], path.name
        side = device.metadata.get("side", "right" if folder == "mesh-hand" else "auto")
        tracker, watch = make_hands_tracker(f"hand.side={side}"), Watch(math.inf)
        for frame in device:
            depth = device.camera.rectify(frame.depth, frame.radial)
            made = tracker.step(depth, device.camera.K, frame.index, frame.timestamp_s)
            watch.see(made, depth, tracker.insights)
        k, (apparent_m,) = device.camera.K, watch.apparent_m()
        assert length_doubt(tracker.fitted[0], k) == "", path.name
        assert apparent_m is None or apparent_doubt(apparent_m, k) == "", path.name
