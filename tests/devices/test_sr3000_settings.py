"""The SR3000: settings that reach the camera, and those that cannot be."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
import usb.core
from helpers.settings import (
    persistence_settings,
    sr3000,
    sr3000_emulator,
    usb_settings,
)
from helpers.sr3000_camera import STEP_M, camera, read

from toftrack.camera import Camera
from toftrack.devices.replay import Sample
from toftrack.devices.sr3000.emulator import EmulatedBackend
from toftrack.devices.sr3000.transport import Exposure
from toftrack.devices.sr3000.usb import UsbTransport
from toftrack.errors import ToftrackError
from toftrack.recordings.store import open_source


def test_settings_reach_the_camera() -> None:
    device = camera(
        modulation_mhz=30,
        integration_time=20,
        usb={"registers": {"3": 7}, "integration_time_register": 5, "modulation_register": 6},
        stop=2,
    )
    read(device)
    assert bytes(device.emulator.registers[:8]) == bytes((0, 0, 0, 7, 0, 20, 1, 0))


def test_modulation_frequency_sets_the_range() -> None:
    device = camera(modulation_mhz=40, stop=1)
    frame = read(device)[0]
    depth = device.camera.rectify(frame.depth, True)
    np.testing.assert_allclose(depth, next(iter(Sample())).depth, atol=0.51 * STEP_M)
    assert device.exposure.range_m == pytest.approx(3.747, abs=1e-3)


def test_amplitude_threshold_takes_the_distance_of_dim_pixels() -> None:
    dim = read(camera(stop=1))[0].amplitude < 500
    frame = read(camera(amplitude_threshold=500, stop=1))[0]
    assert dim.any()
    assert (frame.depth[dim] == 0).all()
    assert (frame.depth[~dim] > 0).mean() > 0.9


@pytest.mark.parametrize(
    ("has", "asked", "words"),
    [
        ({"endpoint_in": 0x81}, {}, "no endpoint 0x86 .it has 0x02, 0x81"),
        ({"endpoint_out": 0x03}, {"registers": {1: 2}}, "no endpoint 0x02 .it has 0x03, 0x86"),
        ({}, {"registers": {1: 2}}, "register 1 "),
    ],
)
def test_a_camera_with_other_endpoints_or_registers_is_reported(
    has: dict[str, Any], asked: dict[str, Any], words: str
) -> None:
    backend = EmulatedBackend(open_source("sample"), sr3000_emulator(), 7.5, usb_settings(**has))
    backend.bulk_write = lambda *_: (_ for _ in ()).throw(usb.core.USBError("Pipe error", -9, 32))
    transport = UsbTransport(usb_settings(**asked), Exposure(20, None, 0), None, backend)
    with pytest.raises(ToftrackError, match=words):
        transport.open()
    assert backend.open_handles == set()


def test_what_a_killed_program_left_in_the_camera_is_not_a_frame() -> None:
    device = camera(stop=3)
    device.emulator._request()  # asked for, but never fetched
    time.sleep(0.01)
    frames = read(device)
    (second,) = Sample(start=1, stop=2)
    assert np.array_equal(frames[0].amplitude, second.amplitude)


def test_camera_file_replaces_the_optics(tmp_path: Any) -> None:
    path = tmp_path / "camera.json"
    Camera(np.array([[210.0, 0, 90], [0, 210, 70], [0, 0, 1]]), 176, 144).save(path)
    assert camera(camera_file=path).camera.K[0, 0] == 210
    Camera(np.eye(3), 10, 10).save(path)
    with pytest.raises(ToftrackError, match="10x10"):
        camera(camera_file=path)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: sr3000("ethernet"), "usb, libmesasr or emulated"),
        (lambda: sr3000("emulated", modulation_mhz=25), "40, 30, 21, 20, 19"),
        (lambda: sr3000("emulated", integration_time=256), "at least 0 and at most 255"),
        (lambda: usb_settings(ids=("1ad2",)), "VENDOR:PRODUCT"),
        (lambda: usb_settings(registers={64: 0}), "at least 0 and at most 63"),
        (lambda: sr3000_emulator(faults=("explode@3",)), "explode"),
        (lambda: sr3000_emulator(faults=("timeout@x",)), "timeout@x"),
        (lambda: persistence_settings(give_up_s=0), "give_up_s"),
    ],
)
def test_bad_settings_are_reported(make: Any, words: str) -> None:
    with pytest.raises(ToftrackError, match=words):
        make()
