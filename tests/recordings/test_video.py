"""Azure Kinect's recordings and grey videos give what went in; others are told."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.videos import (
    RATIONAL,
    START_OFFSET_S,
    calibration,
    write_grey,
    write_kinect,
)

from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.recordings.bare import Given
from toftrack.recordings.store import open_recording
from toftrack.views.video import VideoFile

K = np.array([[252.0, 0, 166.0], [0, 253.0, 140.0], [0, 0, 1]])
ABOUT = calibration(K, 512, (96, 90))
FEMTO = "CALIBRATION_LensDistortionModelRational6KT"
REPORTED = Given((30.0, 31.0, 15.5, 11.5))


def broken(change: Callable[[dict], Any]) -> dict:
    about = calibration(K, 512, (96, 90))
    change(about["CalibrationInformation"]["Cameras"][1])
    return about


def words(count: int = 7, size: tuple[int, int] = (24, 32)) -> np.ndarray:
    return np.random.default_rng(count).integers(0, 0x10000, (count, *size)).astype(np.uint16)


@pytest.fixture(scope="module")
def images() -> tuple[np.ndarray, np.ndarray]:
    """Depth and infrared of a Kinect's smallest mode."""
    return words(7, (288, 320)), words(8, (288, 320))[:7]


def test_a_kinects_recording_gives_depth_infrared_and_times(
    tmp_path: Path, images: tuple[np.ndarray, np.ndarray]
) -> None:
    device = Replay(write_kinect(tmp_path / "a.mkv", *images, ABOUT))
    frames = list(device)
    assert (device.frames, len(frames)) == (7, 7)
    for frame, depth, infrared in zip(frames, *images, strict=True):
        np.testing.assert_allclose(frame.depth, depth / 1000, rtol=1e-6)
        np.testing.assert_array_equal(frame.amplitude, infrared)
        assert not frame.radial
        assert frame.timestamp_s == pytest.approx(START_OFFSET_S + frame.index / 25, abs=2e-3)
    assert device.fps == pytest.approx(25)
    assert device.metadata == {"camera": "Azure Kinect", "serial": "0042"}


@pytest.mark.parametrize(
    ("size", "about"),
    [
        ((320, 288), ABOUT),
        ((640, 576), calibration(K, 1024, (192, 180))),
        ((512, 512), calibration(K, 512, (0, 0))),
        ((1024, 1024), calibration(K, 1024, (0, 0))),
        ((320, 288), broken(lambda c: c["Intrinsics"].update(ModelType=FEMTO))),
    ],
)
def test_every_mode_of_a_kinect_and_a_femto_has_its_part_of_the_lens(
    tmp_path: Path, size: tuple[int, int], about: dict
) -> None:
    path = write_kinect(tmp_path / "a.mkv", np.ones((1, *size[::-1]), np.uint16), about=about)
    camera = open_recording(path).camera
    np.testing.assert_allclose(camera.K, K, atol=1e-9)
    np.testing.assert_allclose(camera.distortion, RATIONAL)
    assert (camera.width, camera.height) == size


@pytest.mark.parametrize("share", [0.5, 0.95])
def test_a_kinects_recording_that_was_cut_off_is_used_so_far(
    tmp_path: Path, images: tuple[np.ndarray, np.ndarray], share: float
) -> None:
    depth = np.concatenate([images[0]] * 3)
    path = write_kinect(tmp_path / "cut.mkv", depth, about=ABOUT)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    store = open_recording(path)
    assert store.damage or share > 0.9, "a frame or two at the end may be missing anyway"
    frames = list(Replay(path))
    assert len(frames) == len(store) == pytest.approx(share * 21, abs=1.01)
    np.testing.assert_allclose(frames[-1].depth, depth[len(frames) - 1] / 1000, rtol=1e-6)


@pytest.mark.parametrize(
    ("about", "complaint"),
    [
        (None, "no attachment calibration.json"),
        (b"{", "calibration.json.*damaged"),
        (broken(lambda c: c["Intrinsics"]["ModelParameters"].pop()), "13 parameters"),
        (broken(lambda c: c.update(SensorWidth=640)), "another kind.*640"),
        (broken(lambda c: c["Intrinsics"].update(ModelType="Theta")), "another kind.*Theta"),
    ],
)
def test_a_calibration_that_tells_no_lens_is_reported(
    tmp_path: Path, about: Any, complaint: str
) -> None:
    path = write_kinect(tmp_path / "a.mkv", np.ones((1, 288, 320), np.uint16), about=about)
    with pytest.raises(ToftrackError, match=rf"{complaint}.*camera\.file"):
        Replay(path)
    Camera(K, 320, 288).save(tmp_path / "camera.json")
    assert Replay(path, camera_file=tmp_path / "camera.json").camera.K[0, 0] == 252


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("a.avi", "ffv1", "gray16le"),
        ("a.mov", "png", "gray16be"),
        ("a.nut", "rawvideo", "gray16le"),
    ],
)
def test_lossless_grey_videos_are_depth_in_millimetres(
    tmp_path: Path, name: str, codec: str, pixels: str
) -> None:
    pixels_in = words()
    store = open_recording(write_grey(tmp_path / name, pixels_in, codec, pixels), REPORTED)
    assert len(store) == 7
    for number, image in enumerate(pixels_in):
        depth, amplitude = store.image(number)
        np.testing.assert_allclose(depth, image / 1000, rtol=1e-6)
        assert amplitude is None
    np.testing.assert_allclose(store.timestamp_s, np.arange(7) / 25, atol=1e-3)
    np.testing.assert_array_equal(store.camera.K, [[30, 0, 15.5], [0, 31, 11.5], [0, 0, 1]])


@pytest.mark.parametrize("name", ["a.mkv", "a.avi", "a.nut"])
def test_a_list_of_other_files_is_no_video(tmp_path: Path, name: str) -> None:
    write_grey(tmp_path / "other.mkv", words())
    (tmp_path / name).write_text("ffconcat version 1.0\nfile other.mkv\n")
    with pytest.raises(ToftrackError, match="cannot be read as a video"):
        open_recording(tmp_path / name, REPORTED)


def test_without_a_camera_a_video_asks_for_one(tmp_path: Path) -> None:
    path = write_grey(tmp_path / "a.mkv", words())
    with pytest.raises(ToftrackError, match=r"--intrinsics FX FY CX CY.*camera\.file"):
        Replay(path)
    Camera(np.diag((30.0, 30, 1)), 32, 24).save(tmp_path / "camera.json")
    assert Replay(path).camera.K[0, 0] == 30
    Camera(np.diag((30.0, 30, 1)), 8, 6).save(tmp_path / "camera.json")
    with pytest.raises(ToftrackError, match="8x6.*32x24"):
        Replay(path)


def test_colour_video_and_what_is_no_video_are_reported(tmp_path: Path) -> None:
    video = VideoFile(tmp_path / "a.mp4", 25.0, (64, 48))
    for _ in range(5):
        video.add(np.zeros((48, 64, 3), np.uint8))
    video.close()
    with pytest.raises(ToftrackError, match="colour or 8-bit images.*yuv420p.*16 bits"):
        Replay(tmp_path / "a.mp4")
    (tmp_path / "b.mp4").write_bytes(b"nonsense" * 99)
    with pytest.raises(ToftrackError, match="b.mp4' cannot be read as a video"):
        Replay(tmp_path / "b.mp4")
