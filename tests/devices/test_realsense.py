"""RealSense cameras through the SDK's software device; skipped where the SDK cannot be loaded."""

import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.bags import recording as ros_recording
from helpers.bags import write_bag
from helpers.settings import realsense, realsense_emulator

from toftrack.devices.realsense.device import (
    RealSense,
    camera_of,
    choose_streams,
    load_sdk,
    set_preset,
)
from toftrack.devices.realsense.emulator import EmulatedCamera
from toftrack.devices.replay import Sample
from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera

FINE = realsense_emulator(fps=500.0, unit_m=0.0001)


@pytest.fixture(scope="module")
def rs() -> ModuleType:
    try:
        return load_sdk()
    except ToftrackError as error:
        pytest.skip(str(error))


def emulated(**changes: Any) -> RealSense:
    settings = {"transport": "emulated", "keep": "every", "emulated": FINE} | changes
    return realsense(**settings)


def test_the_software_device_delivers_the_samples_frames(rs: ModuleType) -> None:
    device, sample = emulated(stop=30), Sample(stop=30)
    assert (device.frames, len(device.truth)) == (30, 30)
    np.testing.assert_allclose(device.camera.K, sample.camera.K, rtol=1e-6)
    frames = list(device)
    assert [frame.index for frame in frames] == list(range(30))
    assert device.dropped == 0
    for got, true in zip(frames, sample, strict=True):
        assert got.depth.dtype == np.float32
        assert not got.radial
        near = true.depth < 6.5  # what 16 bits of 0.1 mm hold
        np.testing.assert_allclose(got.depth[near], true.depth[near], atol=6e-5)
        np.testing.assert_array_equal(got.amplitude, true.amplitude)
        assert got.timestamp_s == pytest.approx(got.index / 500, abs=1e-6)


def test_newest_drops_what_nobody_took_and_leaves_a_gap(rs: ModuleType) -> None:
    device = emulated(keep="newest", emulated=realsense_emulator(fps=200.0, loop=True))
    assert device.frames is None and device.truth is None
    indices = []
    for frame in device:
        indices.append(frame.index)
        time.sleep(0.03)
        if len(indices) == 6:
            break
    assert indices == sorted(set(indices))
    assert device.dropped == indices[-1] - 5 > 6


def record(rs: ModuleType, path: Path, camera: EmulatedCamera) -> Path:
    """What a virtual camera sends, written by the SDK."""
    try:
        recorder = rs.recorder(str(path), camera.device)
    except RuntimeError:  # this SDK writes the other kind
        path = path.with_suffix(".bag")
        recorder = rs.recorder(str(path), camera.device)
    sensor = recorder.query_sensors()[0]
    sensor.open(sensor.get_stream_profiles())
    sensor.start(rs.frame_queue(1000, True))
    camera.start(busy=lambda: False)
    assert camera.ended.wait(20)
    time.sleep(0.2)  # the recorder writes in a thread of its own
    camera.stop()
    sensor.stop()
    sensor.close()
    recorder.pause()
    return path


@pytest.fixture(scope="module")
def recording(rs: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    return record(rs, folder / "hand.db3", EmulatedCamera(rs, realsense_emulator(fps=100.0)))


def test_a_recording_gives_every_frame_in_order_however_slow_its_reader(recording: Path) -> None:
    device = realsense(bag=recording)
    sample = Sample()
    np.testing.assert_allclose(device.camera.K, sample.camera.K, rtol=1e-6)
    count = 0
    for got, true in zip(device, sample, strict=True):
        assert got.index == true.index
        near = true.depth < 65
        np.testing.assert_allclose(got.depth[near], true.depth[near], atol=6e-4)
        np.testing.assert_array_equal(got.amplitude, true.amplitude)
        count += 1
        if count % 20 == 0:
            time.sleep(0.05)
    assert (count, device.dropped) == (100, 0)


def test_a_part_of_a_recording_keeps_its_indices_and_can_be_read_again(recording: Path) -> None:
    device = realsense(bag=recording, start=40, stop=43, infrared=False)
    for _ in range(2):
        frames = list(device)
        assert [frame.index for frame in frames] == [40, 41, 42]
        assert frames[0].amplitude is None


def test_what_is_no_recording_is_reported(rs: ModuleType, tmp_path: Path, recording: Path) -> None:
    for content in (b"", b"text", recording.read_bytes()[:5000]):
        for suffix in (".bag", ".db3"):
            path = tmp_path / f"a{suffix}"
            path.write_bytes(content)
            with pytest.raises(ToftrackError, match="a.*' is not a recording of a RealSense"):
                realsense(bag=path)


@pytest.mark.parametrize("kind", ["bag", "db3"])
def test_a_bag_of_ros_topics_is_told_how_it_is_tracked(
    rs: ModuleType, tmp_path: Path, kind: str
) -> None:
    camera = Camera(np.array([[40.0, 0, 15.5], [0, 41.0, 11.5], [0, 0, 1]]), 32, 24)
    path = write_bag(tmp_path, kind, ros_recording(np.ones((3, 24, 32)), camera))
    bag = path if path.is_file() else next(path.glob("*.db3"))
    with pytest.raises(ToftrackError, match="bag of ROS topics.*toftrack track FILE"):
        realsense(bag=bag)


MODELS = ("brown_conrady", "modified_brown_conrady", "inverse_brown_conrady")


@pytest.mark.parametrize("model", MODELS)
def test_the_cameras_lens_becomes_opencvs(rs: ModuleType, model: str) -> None:
    intrinsics = some_intrinsics(rs, model, [0.1, -0.2, 0.001, -0.002, 0.05])
    camera = camera_of(rs, intrinsics)
    if model == "brown_conrady":
        np.testing.assert_allclose(camera.distortion, intrinsics.coeffs, atol=1e-5)
    points = np.random.default_rng(0).uniform([-0.4, -0.3, 1], [0.4, 0.3, 1], (50, 3))
    seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, camera.distortion)[0]
    true = [rs.rs2_project_point_to_pixel(intrinsics, list(point)) for point in points]
    np.testing.assert_allclose(seen[:, 0], true, atol=0.05)


def test_a_lens_unlike_opencvs_is_reported(rs: ModuleType) -> None:
    with pytest.raises(ToftrackError, match="kannala.*pixels.*camera.file"):
        camera_of(rs, some_intrinsics(rs, "kannala_brandt4", [0.9, -3.0, 9.0, -20.0, 0.0]))


def some_intrinsics(rs: ModuleType, model: str, coefficients: list[float]) -> Any:
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height, intrinsics.ppx, intrinsics.ppy = 640, 480, 321.0, 238.0
    intrinsics.fx, intrinsics.fy = 600.0, 610.0
    intrinsics.model, intrinsics.coeffs = getattr(rs.distortion, model), coefficients
    return intrinsics


def test_without_a_camera_the_user_is_told_what_else_there_is(rs: ModuleType) -> None:
    if len(rs.context().devices):
        pytest.skip("a camera is plugged in")
    with pytest.raises(ToftrackError, match="no RealSense camera.*device.bag.*emulated"):
        realsense()


def test_a_size_that_the_camera_lacks_is_reported_with_those_it_has(rs: ModuleType) -> None:
    camera = EmulatedCamera(rs, FINE).device
    with pytest.raises(ToftrackError, match="width=641, device.height=6, .*one of 176x144 at 500"):
        choose_streams(rs, camera, (641, 6, 30), infrared=False, owner="the camera")


def test_presets_are_chosen_by_name(rs: ModuleType) -> None:
    names = {0.0: "Default", 1.0: "High Accuracy"}
    taken: list[float] = []
    sensor = SimpleNamespace(
        supports=lambda option: True,
        get_option_range=lambda option: SimpleNamespace(min=0.0, max=1.0),
        get_option_value_description=lambda option, value: names[value],
        set_option=lambda option, value: taken.append(value),
    )
    set_preset(rs, sensor, "high_accuracy")
    assert taken == [1.0]
    with pytest.raises(ToftrackError, match="no preset hand.*null, default, high_accuracy"):
        set_preset(rs, sensor, "hand")


@pytest.mark.parametrize(
    ("changes", "reported"),
    [
        ({"transport": "wifi"}, "transport=wifi is unknown"),
        ({"bag": "a.bag", "transport": "emulated"}, "device.emulated.source"),
    ],
)
def test_senseless_settings_are_reported(changes: dict[str, Any], reported: str) -> None:
    with pytest.raises(ToftrackError, match=reported):
        realsense(**changes)


def test_a_missing_or_old_sdk_is_reported_with_the_extra(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    for module in (None, ModuleType("pyrealsense2")):
        monkeypatch.setitem(sys.modules, "pyrealsense2", module)
        with pytest.raises(ToftrackError, match=r"pyrealsense2.*pip install .toftrack\[rea"):
            realsense()
        with pytest.raises(ToftrackError, match="ROS topics goes without: toftrack track FILE"):
            realsense(bag=tmp_path / "a.bag")


def test_a_recording_at_its_own_pace_drops_what_comes_too_late(recording: Path) -> None:
    device = realsense(bag=recording, realtime=True)
    indices = []
    for frame in device:
        indices.append(frame.index)
        time.sleep(0.05)
    assert indices == sorted(set(indices))
    assert 5 < len(indices) < 60
    assert device.dropped > 30
