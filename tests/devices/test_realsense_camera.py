"""RealSense cameras through a stand-in for the SDK: what a camera does, and what goes wrong."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from helpers.fake_realsense import Camera as FakeCamera
from helpers.fake_realsense import Profile, Sdk
from helpers.settings import realsense, realsense_emulator
from helpers.tracking import ROOT

from toftrack.devices.realsense.device import RealSense
from toftrack.errors import ToftrackError


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
    return realsense(**({"width": 8, "height": 6} | changes))


def test_the_sdk_is_not_imported_until_it_is_used() -> None:
    code = "import toftrack.devices.realsense.device, sys; sys.exit('pyrealsense2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_a_missing_sdk_is_reported_with_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(ToftrackError, match=r"pyrealsense2.*pip install -e '.\[realsense\]'"):
        live()


def test_an_old_sdk_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", ModuleType("pyrealsense2"))
    with pytest.raises(ToftrackError, match="older than 2.56"):
        live()


def test_no_camera_is_reported_with_what_else_there_is(plug: Callable[..., Sdk]) -> None:
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


def test_a_size_that_the_camera_lacks_is_reported_with_those_it_has(
    plug: Callable[..., Sdk],
) -> None:
    plug(a_camera())
    with pytest.raises(ToftrackError, match="641x6 pixels at 30.*8x6 at 15, 8x6 at 30"):
        live(width=641)
    assert live(fps=15).fps == 15


def test_a_camera_without_depth_is_reported(plug: Callable[..., Sdk]) -> None:
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


def test_an_unplugged_camera_is_reported_after_its_last_frame(plug: Callable[..., Sdk]) -> None:
    camera = a_camera(frames=(1, 2))
    plug(camera)
    indices = []
    with pytest.raises(ToftrackError, match="was unplugged; plug it in"):
        for frame in live():
            indices.append(frame.index)
            camera.plugged = False
    assert indices == [0, 1]


def test_a_silent_camera_is_reported(plug: Callable[..., Sdk]) -> None:
    sdk = plug(a_camera(frames=(1,)))
    with pytest.raises(ToftrackError, match="no frame has come.*0.05 s"):
        list(live(timeout_s=0.05))
    assert sdk.started is None, "the camera was not let go"


def test_a_camera_in_use_is_reported(plug: Callable[..., Sdk]) -> None:
    plug(a_camera(), start_error="Device or resource\n busy")
    with pytest.raises(ToftrackError, match=r"be started \(Device or resource busy\); close"):
        live().open()


@pytest.mark.parametrize(
    ("changes", "reported"),
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
        ({"bag": __file__}, "test_realsense_camera.py' is not a recording.*device=replay"),
        ({"bag": "a.bag", "transport": "emulated"}, "device.emulated.source"),
    ],
)
def test_senseless_settings_are_reported_without_the_sdk(
    changes: dict[str, Any], reported: str
) -> None:
    with pytest.raises(ToftrackError, match=reported):
        live(**changes)


def test_senseless_settings_of_the_virtual_camera_are_reported() -> None:
    with pytest.raises(ToftrackError, match="fps and unit_m above 0"):
        realsense_emulator(unit_m=0)
