"""What looks wrong in a recording is said with the value that would fit; what is right is not."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from toftrack.api import make_device
from toftrack.devices.replay import Replay
from toftrack.frames.camera import Camera
from toftrack.recordings.doubts import (
    centre_doubt,
    gaps_doubt,
    lens_doubt,
    names_doubt,
    times_doubt,
)

K = np.array([[200.0, 0, 88], [0, 200, 72], [0, 0, 1]])
TIMES = np.array([0, 0.033, 0.067, 0.1, 0.133, 0.5])


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (1e3 * TIMES, "divide them by 1000,"),
        (1800.0 * np.arange(5), "divide them by 1000,"),  # nearer to fast microseconds
        (1e6 * TIMES, "microseconds"),
        (1e7 * TIMES, "divide them by 10000000,"),
        (6e7 * TIMES, "divide them by 60000000,"),
        (1e9 * TIMES, "nanoseconds"),
        (1e-3 * TIMES, "multiply them by"),
        (np.full(5, 3.0), "4 of 5 time stamps repeat"),
        (np.floor(np.arange(60) / 25), "57 of 60"),
    ],
)
def test_times_that_are_not_of_frames_are_reported(times: np.ndarray, words: str) -> None:
    assert words in times_doubt(times + 17)


@pytest.mark.parametrize(
    "times",
    [TIMES, TIMES + 1.7e9, np.arange(9) / 300, np.arange(9.0), np.zeros(1), [0, 0, 0.1, 0.1, 0.2]],
)
def test_times_of_cameras_are_not_doubted(times: np.ndarray) -> None:
    assert times_doubt(np.asarray(times)) == ""


def test_gaps_in_time_are_counted_with_the_first() -> None:
    assert "1 of 5 steps" in gaps_doubt(TIMES) and "s, after frame 4;" in gaps_doubt(TIMES)
    for whole in (TIMES[:5], TIMES[:1], np.zeros(4)):
        assert gaps_doubt(whole) == ""


@pytest.mark.parametrize(
    ("distortion", "lens", "words"),
    [
        ([8.0, 3, 0, 0, 0], "opencv", "zeros would leave 100 %"),
        ([-8.0, 0, 0, 0, 0], "opencv", "zeros would leave 100 %"),
        ([0.1, -0.3, 0.8, 0, 0], "opencv", "if they were given as k1 k2 k3 p1 p2"),
        ([0.09, -0.27, 0, 0, 0.09], "opencv", ""),
        ([0.1, -0.01, 0.01, 0.002], "fisheye", ""),
    ],
)
def test_a_lens_that_leaves_little_of_the_image_is_reported(
    distortion: list, lens: str, words: str
) -> None:
    doubt = lens_doubt(Camera(K, 176, 144, distortion, lens=lens))
    assert words in doubt and bool(doubt) == bool(words)


@pytest.mark.parametrize(
    ("centre", "words"),
    [
        ((70, 80), ""),
        ((176, 144), "images of about 352x288 pixels have"),
        ((44, 36), "images of about 88x72 pixels have"),
        ((88, -20), "unless they are cut out of larger"),
    ],
)
def test_the_centre_of_another_resolution_is_reported(centre: tuple, words: str) -> None:
    doubt = centre_doubt(Camera([[200, 0, centre[0]], [0, 200, centre[1]], [0, 0, 1]], 176, 144))
    assert words in doubt and bool(doubt) == bool(words)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ("depth_{:04}.png 1 2 3 7 8 10", "leave out 4 (4-6, 9)"),
        ("s2/depth_{}_v1.png 10 20 50", "leave out 2 (30-40)"),
        (f"{{}}.png 0 1 {' '.join(map(str, range(3, 27, 2)))}", "18, 20, ...)"),
        ("{}.png 0 5 10 15", ""),  # every fifth was kept
        ("{}.png 1700000033 1700000066 1700000100 1700000133", ""),  # milliseconds
        ("{}.png 4", ""),
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
    folder = Replay(tmp_path, intrinsics=[200, 200, 88, 72])
    assert folder.description["files"] == ["depth_1.png", "depth_2.png", "depth_5.png"]
    assert "leave out 2 (3-4)" in folder.description["doubts"][0]
    (tmp_path / "timestamps.txt").write_text("0.04\n0.08\n0.12\n")
    assert Replay(tmp_path, intrinsics=[200, 200, 88, 72]).description["doubts"] == []


def test_a_folder_in_another_unit_is_reported(tmp_path: Path) -> None:
    with make_device("device=sample", "device.stop=1") as sample:
        depth = next(iter(sample)).depth
    tenths = "0.0001 m a step instead of 0.001, or 0.000125 of an SR300 or SR305"
    for step_m, right in ((0.01, "0.01 m a step"), (0.0001, tenths), (0.000125, tenths)):
        cv2.imwrite(str(tmp_path / "0.png"), (depth / step_m).astype(np.uint16))
        given = {"intrinsics": [200, 200, 88, 72]}
        (doubt,) = Replay(tmp_path, **given).description["doubts"]
        assert right in doubt and "device.unit_m" in doubt
        assert not Replay(tmp_path, unit_m=step_m, **given).description["doubts"]


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
