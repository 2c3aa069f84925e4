"""RealSense cameras: through the SDK's software device, and a stand-in for what only a camera does.

The tests of the first half are skipped where pyrealsense2 cannot be loaded.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import hydra
import numpy as np
import pytest
from fake_realsense import Camera as FakeCamera
from fake_realsense import Profile, Sdk
from tracking import ROOT, configuration, make_tracker

from toftrack.camera import Camera
from toftrack.devices.base import Device
from toftrack.devices.realsense import RealSense
from toftrack.devices.realsense_emulator import EmulatedCamera, EmulatorSettings
from toftrack.devices.realsense_sdk import camera_of, load_sdk
from toftrack.devices.sample import Sample
from toftrack.errors import ToftrackError

FINE = EmulatorSettings(fps=500.0, unit_m=0.0001)


@pytest.fixture
def rs() -> ModuleType:
    try:
        return load_sdk()
    except ToftrackError as error:
        pytest.skip(str(error))


def emulated(**changes: Any) -> RealSense:
    settings = {"transport": "emulated", "keep": "every", "emulated": FINE} | changes
    return RealSense(**settings)


def test_the_software_device_delivers_the_samples_frames(rs: ModuleType) -> None:
    device, sample = emulated(stop=30), Sample(stop=30)
    assert isinstance(device, Device)
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


def test_tracks_as_well_through_the_sdk_as_the_recording_itself(rs: ModuleType) -> None:
    def error_mm(device: Device) -> float:
        tracker, errors = make_tracker(), []
        for row, frame in enumerate(device):
            depth = device.camera.rectify(frame.depth, frame.radial)
            estimate = tracker.step(depth, device.camera.K, frame.index, frame.timestamp_s)
            errors.append(np.linalg.norm(estimate.joints_m - device.truth.joints_m[row], axis=-1))
        assert len(errors) == 25
        return 1e3 * float(np.mean(errors))

    straight = error_mm(Sample(stop=25))
    for unit_m in (0.001, 0.0001):
        settings = EmulatorSettings(fps=500.0, unit_m=unit_m)
        assert error_mm(emulated(stop=25, emulated=settings)) == pytest.approx(straight, abs=1)


def test_the_configuration_makes_the_device(rs: ModuleType) -> None:
    config = configuration(
        "device=realsense",
        "device.transport=emulated",
        "device.keep=every",
        "device.start=2",
        "device.stop=4",
        "device.emulated.fps=500",
    )
    assert [frame.index for frame in hydra.utils.instantiate(config.device)] == [2, 3]


def test_newest_drops_what_nobody_took_and_leaves_a_gap(rs: ModuleType) -> None:
    device = emulated(keep="newest", emulated=EmulatorSettings(fps=200.0, loop=True))
    assert device.frames is None and device.truth is None
    indices = []
    for frame in device:
        indices.append(frame.index)
        time.sleep(0.03)
        if len(indices) == 6:
            break
    assert indices == sorted(set(indices))
    assert device.dropped == indices[-1] - 5 > 6


def test_leaving_stops_the_camera_and_iterating_again_starts_it_again(rs: ModuleType) -> None:
    device = emulated()
    for _ in range(2):
        indices = []
        for frame in device:
            indices.append(frame.index)
            if len(indices) == 3:
                break
        assert indices == [0, 1, 2]


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
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    try:
        rs = load_sdk()
    except ToftrackError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("recordings")
    return record(rs, folder / "hand.db3", EmulatedCamera(rs, EmulatorSettings(fps=100.0)))


def test_a_recording_gives_every_frame_in_order_however_slow_its_reader(recording: Path) -> None:
    device = RealSense(bag=recording)
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
    device = RealSense(bag=recording, start=40, stop=43, infrared=False)
    for _ in range(2):
        frames = list(device)
        assert [frame.index for frame in frames] == [40, 41, 42]
        assert frames[0].amplitude is None


def test_a_recording_at_its_own_pace_drops_what_comes_too_late(recording: Path) -> None:
    device = RealSense(bag=recording, realtime=True)
    indices = []
    for frame in device:
        indices.append(frame.index)
        time.sleep(0.05)
    assert indices == sorted(set(indices))
    assert 5 < len(indices) < 60
    assert device.dropped > 30


def test_a_start_behind_the_end_is_told(recording: Path) -> None:
    with pytest.raises(ToftrackError, match="no frame from start=100 on, but 100 before"):
        list(RealSense(bag=recording, start=100))


def test_a_recording_without_depth_is_told(rs: ModuleType, tmp_path: Path) -> None:
    class InfraredOnly(EmulatedCamera):
        def _stream(self, uid: int, kind: Any, index: int, pixel_format: Any) -> Any:
            if kind == rs.stream.depth:
                return None
            return super()._stream(uid, kind, index, pixel_format)

        def _deliver(self, profile: Any, pixels: np.ndarray, number: int) -> None:
            if profile is not None:
                super()._deliver(profile, pixels, number)

    path = record(rs, tmp_path / "infrared.db3", InfraredOnly(rs, FINE))
    with pytest.raises(ToftrackError, match="infrared.* has no depth images"):
        RealSense(bag=path)


def test_a_recording_without_a_frame_is_told(rs: ModuleType, tmp_path: Path) -> None:
    class Silent(EmulatedCamera):
        def _send(self, number: int) -> None: ...

    path = record(rs, tmp_path / "silent.db3", Silent(rs, FINE))
    with pytest.raises(ToftrackError, match="silent.*has no (depth images|frame with depth)"):
        list(RealSense(bag=path))


@pytest.mark.parametrize("name", ["text.bag", "text.db3", "empty.bag", "empty.db3", "cut"])
def test_what_is_no_recording_is_told(
    rs: ModuleType, tmp_path: Path, recording: Path, name: str
) -> None:
    path = tmp_path / (f"cut{recording.suffix}" if name == "cut" else name)
    content = recording.read_bytes()[:5000] if name == "cut" else b"text" * ("text" in name)
    path.write_bytes(content)
    with pytest.raises(ToftrackError, match=rf"{path.name}' is not a recording of a RealSense"):
        RealSense(bag=path)


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


def test_a_camera_without_distortion_has_none(rs: ModuleType) -> None:
    for model, coefficients in (("brown_conrady", [0.0] * 5), ("none", [0.3] * 5)):
        assert not camera_of(rs, some_intrinsics(rs, model, coefficients)).distortion.any()


def test_a_lens_unlike_opencvs_is_told(rs: ModuleType) -> None:
    with pytest.raises(ToftrackError, match="kannala.*pixels.*camera.file"):
        camera_of(rs, some_intrinsics(rs, "kannala_brandt4", [0.9, -3.0, 9.0, -20.0, 0.0]))


def some_intrinsics(rs: ModuleType, model: str, coefficients: list[float]) -> Any:
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height, intrinsics.ppx, intrinsics.ppy = 640, 480, 321.0, 238.0
    intrinsics.fx, intrinsics.fy = 600.0, 610.0
    intrinsics.model, intrinsics.coeffs = getattr(rs.distortion, model), coefficients
    return intrinsics


def test_a_camera_file_of_another_size_is_told(rs: ModuleType, tmp_path: Path) -> None:
    Camera(np.diag([200.0, 200, 1]), 320, 240).save(tmp_path / "camera.json")
    with pytest.raises(ToftrackError, match="320x240.*176x144"):
        emulated(camera_file=tmp_path / "camera.json")


def test_without_a_camera_the_user_is_told_at_once(rs: ModuleType, tmp_path: Path) -> None:
    if len(rs.context().devices):
        pytest.skip("a camera is plugged in")
    done = subprocess.run(
        [sys.executable, "track.py", "device=realsense", f"hydra.run.dir={tmp_path}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("error: no RealSense camera")
    assert done.stderr.count("\n") == 1


# From here on without the SDK.


def a_camera(serial: str = "0042", frames: tuple[int | None, ...] = ()) -> FakeCamera:
    profiles = [Profile("infrared", "y8"), Profile("depth", "z16"), Profile("depth", "z16", fps=15)]
    return FakeCamera(serial, profiles, list(frames))


@pytest.fixture
def plug(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Sdk]:
    def installed(*cameras: FakeCamera, **changes: Any) -> Sdk:
        sdk = Sdk(*cameras, **changes)
        monkeypatch.setitem(sys.modules, "pyrealsense2", sdk)
        return sdk

    return installed


def live(**changes: Any) -> RealSense:
    return RealSense(**({"width": 8, "height": 6} | changes))


def test_the_sdk_is_not_imported_until_it_is_used() -> None:
    code = "import toftrack.devices.realsense, sys; sys.exit('pyrealsense2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_a_missing_sdk_is_told_with_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(ToftrackError, match=r"pyrealsense2.*pip install -e '.\[realsense\]'"):
        live()


def test_an_old_sdk_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", ModuleType("pyrealsense2"))
    with pytest.raises(ToftrackError, match="older than 2.56"):
        live()


def test_no_camera_is_told_with_what_else_there_is(plug: Callable[..., Sdk]) -> None:
    plug()
    with pytest.raises(ToftrackError, match="no RealSense camera.*device.bag.*emulated"):
        live()


def test_one_of_several_cameras_is_chosen_by_its_serial(plug: Callable[..., Sdk]) -> None:
    plug(a_camera("0042"), a_camera("77"))
    with pytest.raises(ToftrackError, match="2 RealSense cameras.*0042, 77"):
        live()
    assert live(serial=42).description["serial"] == "0042"
    assert live(serial="77").description["serial"] == "77"
    with pytest.raises(ToftrackError, match="serial number 5; there is 0042, 77"):
        live(serial=5)


def test_a_size_that_the_camera_lacks_is_told_with_those_it_has(plug: Callable[..., Sdk]) -> None:
    plug(a_camera())
    with pytest.raises(ToftrackError, match="641x6 pixels at 30.*8x6 at 15, 8x6 at 30"):
        live(width=641)
    assert live(fps=15).fps == 15


def test_a_camera_without_depth_is_told(plug: Callable[..., Sdk]) -> None:
    plug(FakeCamera("1", [Profile("color", "rgb8")], []))
    with pytest.raises(ToftrackError, match="the camera has no depth images"):
        live()


def test_presets_go_by_their_names(plug: Callable[..., Sdk]) -> None:
    camera = a_camera()
    plug(camera)
    live(preset="high_accuracy")
    assert camera.sensor.preset == 1
    with pytest.raises(ToftrackError, match="no preset hand.*null, default, high_accuracy"):
        live(preset="hand")


def test_live_frames_are_counted_from_the_first_and_dropped_ones_leave_a_gap(
    plug: Callable[..., Sdk],
) -> None:
    plug(a_camera(frames=(70, 71, None, 74, 3, 4, 9_000_000)))  # twice the camera counts anew
    device = live(stop=8)
    frames = list(device)
    assert [frame.index for frame in frames] == [0, 1, 4, 5, 6, 7]
    assert device.dropped == 2
    assert frames[0].timestamp_s == pytest.approx(1.07)
    assert frames[0].depth[0, 0] == np.float32(0.07)
    assert frames[0].amplitude is None


def test_an_unplugged_camera_is_told_after_its_last_frame(plug: Callable[..., Sdk]) -> None:
    camera = a_camera(frames=(1, 2))
    plug(camera)
    indices = []
    with pytest.raises(ToftrackError, match="was unplugged; plug it in"):
        for frame in live():
            indices.append(frame.index)
            camera.plugged = False
    assert indices == [0, 1]


def test_a_silent_camera_is_told(plug: Callable[..., Sdk]) -> None:
    sdk = plug(a_camera(frames=(1,)))
    with pytest.raises(ToftrackError, match="no frame has come.*0.05 s"):
        list(live(timeout_s=0.05))
    assert sdk.started is None, "the camera was not let go"


def test_a_camera_in_use_is_told(plug: Callable[..., Sdk]) -> None:
    plug(a_camera(), start_error="Device or resource\n busy")
    with pytest.raises(ToftrackError, match=r"be started \(Device or resource busy\); close"):
        live().open()


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"transport": "wifi"}, "transport=wifi is unknown"),
        ({"keep": "all"}, "keep=newest or every"),
        ({"queue_frames": 1}, "queue_frames of at least 2"),
        ({"timeout_s": 0}, "timeout_s above 0"),
        ({"timeout_s": "long"}, "timeout_s above 0"),
        ({"start": 3, "stop": 3}, "0 <= start < stop"),
        ({"start": "a"}, "0 <= start < stop"),
        ({"stop": 2.5}, "0 <= start < stop"),
        ({"bag": "missing.bag"}, "there is no file 'missing.bag'"),
        ({"bag": __file__}, "test_realsense.py' is not a recording.*device=replay"),
        ({"bag": "a.bag", "transport": "emulated"}, "device.emulated.source"),
    ],
)
def test_senseless_settings_are_told_without_the_sdk(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(ToftrackError, match=told):
        live(**changes)


def test_senseless_settings_of_the_virtual_camera_are_told() -> None:
    with pytest.raises(ToftrackError, match="fps and unit_m above 0"):
        EmulatorSettings(unit_m=0)
