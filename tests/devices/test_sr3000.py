"""The SR3000: the real driver against a virtual camera that misbehaves in every way known."""

import gc
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import usb.core
from helpers import programs
from helpers.programs import QUICK
from helpers.settings import persistence_settings, sr3000, sr3000_emulator, usb_settings

from toftrack.devices.replay import Sample
from toftrack.devices.sr3000 import usb as sr3000_usb
from toftrack.devices.sr3000.device import Sr3000
from toftrack.devices.sr3000.emulator import EmulatedBackend, EmulatorSettings
from toftrack.devices.sr3000.transport import EndOfStreamError, Exposure
from toftrack.devices.sr3000.usb import UsbTransport
from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.recordings.sr_frame import FRAME_BYTES, unambiguous_range_m
from toftrack.recordings.store import open_source

FAST = {"fps": 1000.0, "replug_s": 0.02, "late_s": 0.06}
STEP_M = unambiguous_range_m(20) / 0xFFFF


def camera(*faults: str, keep: str = "every", **changes: Any) -> Sr3000:
    """A virtual camera that is fast, and whose driver is impatient."""
    settings = {"faults": faults} | FAST
    settings |= {k: changes.pop(k) for k in list(changes) if k in EmulatorSettings.__annotations__}
    persistence = {"first_frame_s": 0.6, "give_up_s": 0.6, "backoff_s": 0.01} | changes.pop(
        "persistence", {}
    )
    usb_ = {"timeout_ms": 40, "drain_ms": 3, "tail_check_ms": 1} | changes.pop("usb", {})
    return sr3000(
        transport="emulated",
        keep=keep,
        emulated=sr3000_emulator(**settings),
        persistence=persistence_settings(**persistence),
        usb=usb_settings(**usb_),
        **changes,
    )


def read(device: Sr3000) -> list[Any]:
    """The frames of a virtual camera that is then closed, with a look at what was left behind."""
    with device:
        frames = list(device)
    assert_released(device)
    return frames


@pytest.fixture(scope="module")
def sample() -> list[Any]:
    return list(Sample())


def assert_released(device: Sr3000) -> None:
    assert device.emulator.open_handles == set()
    assert device.emulator.misuse == []
    assert "sr3000-reader" not in [thread.name for thread in threading.enumerate()]


def assert_is_the_sample(device: Sr3000, frames: list[Any], sample: list[Any]) -> None:
    """Every frame is the sample's of its index, to the rounding of the distance word."""
    for frame in frames:
        depth = device.camera.rectify(frame.depth, frame.radial)
        np.testing.assert_allclose(depth, sample[frame.index].depth, atol=0.51 * STEP_M)
        np.testing.assert_array_equal(frame.amplitude, sample[frame.index].amplitude)


def test_serves_the_sample_whole_and_in_order(sample: list[Any]) -> None:
    device = camera()
    frames = read(device)
    assert [frame.index for frame in frames] == list(range(100))
    assert (np.diff([frame.timestamp_s for frame in frames]) >= 0).all()
    assert frames[0].radial
    assert_is_the_sample(device, frames, sample)
    assert device.counts.received == device.counts.delivered == device.emulator.served == 100
    assert device.truth.joints_m.shape == (100, 21, 3)
    assert device.frames == 100


PASSING = (
    "timeout@5 timeout@0x10 refuse@5 stall@5 stall@0x7 io_error@0x2 overflow@5 short@5 short@0x6 "
    "cut@5 empty@5 long@5 unplug_before@5 unplug_during@5 unplug_after@5 unplug_before@0x3 "
    "unplug_during@0x3"
)
"""Faults that pass: from which request on, and how often."""
LOST = {"overflow", "short", "cut", "empty", "long", "unplug_before", "unplug_during"}
"""The frame is lost, and so leaves a gap."""


@pytest.mark.parametrize("fault", PASSING.split())
def test_recovers(fault: str, sample: list[Any]) -> None:
    kind, _, when = fault.partition("@")
    first, _, count = when.partition("x")
    hit = range(int(first), int(first) + int(count or 1))
    # Patient, so that a busy machine does not pass for a camera that is silent.
    patient = {"first_frame_s": 20.0, "give_up_s": 20.0}
    device = camera(fault, stop=15, persistence=patient)
    frames = read(device)
    expected = [i for i in range(15) if not (kind in LOST and i in hit)]
    if kind == "unplug_after":  # the frame came, and the break behind it takes an index
        expected.remove(hit.stop)
    assert [frame.index for frame in frames] == expected
    assert_is_the_sample(device, frames, sample)


def test_a_late_frame_is_not_taken_for_the_next(sample: list[Any]) -> None:
    for late_s in (0.02, 0.05, 0.1):
        device = camera("late@5", "late@11", late_s=late_s, stop=40)
        frames = read(device)
        indices = [frame.index for frame in frames]
        assert indices == sorted(set(indices))
        assert len(indices) > 25
        after = [frame.amplitude for frame in frames if frame.index > 5]
        assert not any(np.array_equal(one, sample[5].amplitude) for one in after), "the late one"


def test_a_frame_in_two_transfers_at_every_packet(sample: list[Any]) -> None:
    packets = FRAME_BYTES // 512
    device = camera(f"split@0x{packets - 1}", loop=True, fps=5000.0, stop=packets - 1)
    frames = read(device)
    assert [frame.index for frame in frames] == list(range(packets - 1))
    for frame in frames:
        assert np.array_equal(frame.amplitude, sample[frame.index % 100].amplitude)
    assert device.counts.damaged == 0


@pytest.mark.parametrize(
    ("kind", "distance"), [("zeros", 0.0), ("ones", unambiguous_range_m(20)), ("garbage", None)]
)
def test_nonsense_of_the_right_length_is_a_frame(kind: str, distance: float | None) -> None:
    frames = read(camera(f"{kind}@1", stop=3))
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert np.isfinite(frames[1].depth).all()
    if distance is not None:
        np.testing.assert_allclose(frames[1].depth, distance, rtol=1e-6)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        *(
            (kind, "libmesasr.*emulated") for kind in ("timeout", "refuse", "short")
        ),  # from the first
        ("timeout@4+", "cable and power"),
        ("short@4+", "cable and power"),
        ("unplug_during@4", "gone.*no SR3000"),
    ],
)
def test_a_camera_that_is_given_up_is_reported_after_its_last_frame(fault: str, words: str) -> None:
    # Over and over: a short frame uses up one of the recording, which else ends on a fast machine.
    device, seen = camera(fault, loop=True, replug_s=100.0), []
    with pytest.raises(ToftrackError, match=words), device:
        for frame in device:
            seen.append(frame.index)
    assert seen == ([0, 1, 2, 3] if "@" in fault else [])
    assert device.emulator.open_handles == set()


def test_never_gives_up_when_asked_not_to() -> None:
    device = camera("timeout@2x20", persistence={"give_up_s": None, "first_frame_s": 0.1}, stop=4)
    assert [frame.index for frame in read(device)] == [0, 1, 2, 3]


def test_no_camera_and_no_library_are_reported_with_the_ids(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def no_library(**_: Any) -> None:
        raise usb.core.NoBackendError("No backend available")

    with pytest.raises(
        ToftrackError, match="1ad2:0074.*no depth camera is seen.*plug.*libmesasr.*emulated"
    ):
        camera("missing")
    monkeypatch.setattr(sr3000_usb.usb.core, "find", no_library)
    with pytest.raises(ToftrackError, match="0852:0074, 1ad2:0074.*libusb.*libmesasr.*emulated"):
        sr3000()


@pytest.mark.parametrize(("kind", "words"), [("permission", "udev"), ("busy", "another program")])
def test_a_camera_that_cannot_be_opened_is_reported(kind: str, words: str) -> None:
    device = camera(kind)
    with pytest.raises(ToftrackError, match=words):
        device.open()
    assert_released(device)


@pytest.mark.parametrize("kind", ["permission", "busy"])
def test_after_plugging_in_again_it_may_take_a_while_to_open(kind: str) -> None:
    # The udev rule, or another program, comes first: the attempts after the first one fail.
    device = camera("unplug_before@3", f"{kind}@1x3", stop=8)
    assert [frame.index for frame in read(device)] == [0, 1, 2, 4, 5, 6, 7]


def test_two_cameras_need_a_choice() -> None:
    with pytest.raises(ToftrackError, match="2 cameras.*A1, B2.*device.serial"):
        camera(serials=("A1", "B2"))
    device = camera(serials=("A1", "B2"), serial="B2", stop=3)
    assert len(read(device)) == 3
    assert device.description["serial"] == "B2"
    with pytest.raises(ToftrackError, match="serial number C3"):
        camera(serials=("A1", "B2"), serial="C3")


def test_close_twice_and_open_again() -> None:
    device = camera(loop=True)
    for _ in range(2):
        device.open()
        assert next(iter(device)).index == 0
        device.close()
        device.close()
        assert_released(device)


def test_iterating_again_goes_on() -> None:
    # A camera without an end: frames that wait when an iteration ends are dropped, and how many had
    # been read by then is a matter of threads.
    device = camera(loop=True)
    with device:
        first = [frame.index for _, frame in zip(range(3), device, strict=False)]
        gc.collect()  # the first iteration is over
        second = [frame.index for _, frame in zip(range(3), device, strict=False)]
    assert first == [0, 1, 2]
    assert second[0] > 2
    assert len(second) == 3
    assert sorted(set(second)) == second


def test_ctrl_c_during_a_transfer_releases_the_camera() -> None:
    device = camera(loop=True, fps=2.0, usb={"timeout_ms": 1000})
    received = programs.interrupted_when(lambda: device.counts.received)
    with pytest.raises(KeyboardInterrupt), device, received:
        for _ in device:
            pass
    assert_released(device)


def test_a_slow_consumer_gets_the_newest_frame_and_the_rest_is_counted() -> None:
    device, frames = camera(keep="newest", fps=200.0), []
    with device:
        for frame in device:
            frames.append(frame)
            seen = device.counts.received
            while device.counts.received < min(seen + 3, 100):
                time.sleep(0.001)
    indices = [frame.index for frame in frames]
    assert indices[-1] == 99
    assert indices == sorted(set(indices))
    assert len(indices) < 60
    counts = device.counts
    assert counts.delivered == len(indices)
    assert counts.delivered + counts.dropped == counts.received == device.emulator.served == 100
    assert device.live and device.dropped == counts.dropped


def test_a_slow_consumer_gets_every_frame_if_wanted_so() -> None:
    device, count = camera(queue_frames=3, stop=40), 0
    with device:
        for _ in device:
            count += 1
            time.sleep(0.002)
    assert (count, device.counts.dropped, device.dropped, device.live) == (40, 0, 0, False)


def test_stopping_delivers_what_was_received() -> None:
    device, indices = camera(loop=True, queue_frames=20), []
    with device:
        for frame in device:
            indices.append(frame.index)
            if frame.index == 0:
                while device.counts.received < 16:
                    time.sleep(0.001)
                device.request_stop()
    assert len(indices) == device.counts.received > 15
    assert indices == list(range(len(indices)))


def test_a_camera_that_hangs_in_a_call_is_not_closed_beneath_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, goes_on, acquired = [True], threading.Event(), UsbTransport.acquire

    def acquire(transport: UsbTransport) -> bytes:
        if first:
            first.clear()
            return acquired(transport)
        goes_on.wait()
        raise EndOfStreamError

    monkeypatch.setattr(UsbTransport, "acquire", acquire)
    device = camera()
    frames = iter(device)
    next(frames)
    try:
        device.close()
        assert device.emulator.open_handles  # or a driver's library would crash the process
    finally:
        goes_on.set()
        frames.close()


def test_every_kind_of_fault_in_turn_and_every_good_frame_accounted_for() -> None:
    device = camera(keep="newest", loop=True, fps=500.0, fault_every=5, stop=5 * 20)
    frames = read(device)
    counts = device.counts
    assert counts.delivered + counts.dropped == counts.received
    assert counts.received == device.emulator.served
    assert counts.unplugged >= 3
    assert len(frames) > 40


# Settings.


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
        (lambda: sr3000("ethernet"), "usb, libmesasr, emulated"),
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


def test_tracks_through_faults_and_an_unplugged_cable(tmp_path: Path) -> None:
    faults = "device.emulated.faults=[unplug_during@6,short@9,zeros@12,timeout@14]"
    camera = ("device=sr3000", "device.transport=emulated", "device.keep=every", "device.stop=24")
    usual = ("device.usb.timeout_ms=99", "view=none", "hydra.run.dir=out", *QUICK)
    status, out, err = programs.call(*camera, *usual, faults, folder=tmp_path)
    assert status == 0, err
    with np.load(tmp_path / "out" / "track.npz") as result:
        assert len(result["joints_m"]) == 24
        assert result["lost"][12]  # the frame without a reading
        assert not result["lost"][-3:].any()
    assert "22 delivered" in out + err
