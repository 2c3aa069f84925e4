"""Orbbec cameras through a stand-in for the SDK: what a camera does, and what goes wrong."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from helpers.fake_orbbec import DEPTH, IR, LEFT_IR, Images, Sdk, image, profile
from helpers.fake_orbbec import Camera as FakeCamera
from helpers.settings import orbbec

from toftrack.errors import ToftrackError

LENS = (0.1, -0.2, 0.05, 0.3, -0.04, 0.01, 0.001, -0.002)
"""k1 to k6, p1, p2."""


Plug = Callable[..., Sdk]


def a_camera(
    serial: str = "0042", numbers: tuple[int, ...] = (), infrared: str | None = IR
) -> FakeCamera:
    profiles = {DEPTH: [profile("y16"), profile("y16", fps=15), profile("y16", (16, 12))]}
    profiles[DEPTH].append(profile("mjpg", (99, 99)))
    if infrared is not None:
        profiles[infrared] = [profile("y8", (16, 12)), profile("y8")]
    sets = [Images(image(n), image(n, np.uint8) if infrared else None) for n in numbers]
    return FakeCamera(serial, profiles, sets)


@pytest.fixture
def plug(monkeypatch: pytest.MonkeyPatch) -> Plug:
    def installed(*cameras: FakeCamera, **changes: Any) -> Sdk:
        sdk = Sdk(*cameras, **changes)
        monkeypatch.setitem(sys.modules, "pyorbbecsdk", sdk)
        return sdk

    return installed


def test_frames_are_metres_infrared_and_seconds(plug: Plug) -> None:
    camera = a_camera(numbers=(70, 71, 72))
    plug(camera)
    device = orbbec(keep="every", stop=3)
    frames = list(device)
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert frames[1].timestamp_s == pytest.approx(5.071)
    assert frames[1].depth.dtype == np.float32
    np.testing.assert_allclose(frames[1].depth, np.full((6, 8), 71 * 0.25e-3))
    np.testing.assert_array_equal(frames[1].amplitude, np.full((6, 8), 71))
    assert frames[1].amplitude.dtype == np.uint16 and not frames[1].radial
    np.testing.assert_array_equal(device.camera.K, [[9, 0, 4], [0, 8, 3], [0, 0, 1]])
    assert device.description["serial"] == "0042" and device.fps == 30
    assert not camera.started, "the camera is stopped"
    for frame in device:  # and is started again
        assert frame.index == 0 and len(camera.started) == 2
        break
    assert not camera.started
    device.close()


def test_where_the_camera_tells_no_time_it_is_that_of_arrival(plug: Plug) -> None:
    camera = a_camera(numbers=(70, 71))
    for images in camera.sets:
        images.get_depth_frame().values["timestamp_us"] = 0
    plug(camera)
    times = [frame.timestamp_s for frame in orbbec(keep="every", stop=2)]
    assert times == pytest.approx([9.07, 9.071])


@pytest.mark.parametrize("infrared", [LEFT_IR, None])
def test_infrared_is_the_left_cameras_or_none(plug: Plug, infrared: str | None) -> None:
    plug(a_camera(numbers=(1,), infrared=infrared))
    frame = next(iter(orbbec(keep="every", stop=1)))
    assert (frame.amplitude is None) == (infrared is None)
    assert next(iter(orbbec(keep="every", stop=1, infrared=False))).amplitude is None


def test_dropped_frames_leave_a_gap_and_a_camera_may_count_anew(plug: Plug) -> None:
    camera = a_camera(numbers=(70, 71, 74, 3, 4, 9_000_000))
    camera.sets.insert(2, Images(None))  # the infrared image came alone
    plug(camera)
    device = orbbec(keep="every", stop=8)
    assert [frame.index for frame in device] == [0, 1, 4, 5, 6, 7]
    assert device.dropped == 2
    assert [frame.index for frame in orbbec(keep="every", start=4, stop=6)] == [4, 5]


def test_an_unplugged_camera_is_reported_after_its_last_frame(plug: Plug) -> None:
    camera = a_camera(numbers=(1, 2))
    plug(camera)
    indices = []
    with pytest.raises(ToftrackError, match="was unplugged; plug it in"):
        for frame in orbbec(keep="every"):
            indices.append(frame.index)
            camera.plugged = False
    assert indices == [0, 1]


@pytest.mark.parametrize(
    ("sent", "error", "words"),
    [
        ([Images(image(1))], None, "no frame has come.*0.05 s"),
        ([Images(image(1, few=True))], None, "sent 5 bytes for 8x6 pixels"),
        ([], "busy\nor so", r"cannot be started \(busy or so\); close other"),
    ],
)
def test_a_camera_that_fails_is_reported(
    plug: Plug, sent: list[Images], error: str | None, words: str
) -> None:
    camera = a_camera()
    camera.sets = sent
    plug(camera, **({} if error is None else {"start_error": error}))
    with pytest.raises(ToftrackError, match=words):
        list(orbbec(timeout_s=0.05))
    assert not camera.started


def test_one_of_several_cameras_is_chosen_by_its_serial(plug: Plug) -> None:
    plug(a_camera("0042"), a_camera("CL77"))
    with pytest.raises(ToftrackError, match="2 Orbbec cameras.*device.serial to one of 0042, CL77"):
        orbbec()
    assert orbbec(serial=42).description["serial"] == "0042"
    assert orbbec(serial="CL77").description["serial"] == "CL77"
    with pytest.raises(ToftrackError, match="serial number 5; .* 0042, CL77"):
        orbbec(serial=5)
    plug(a_camera("CL77"), a_camera("CL77"))  # listed twice
    assert orbbec(serial="CL77").description["serial"] == "CL77"


def test_a_size_that_the_camera_lacks_is_reported_with_those_it_has(
    plug: Plug,
) -> None:
    plug(a_camera())
    with pytest.raises(ToftrackError, match="width=641.*8x6 at 15, 8x6 at 30, 16x12 at 30"):
        orbbec(width=641)
    assert orbbec(fps=15).fps == 15
    assert orbbec(width=16, height=12).camera.width == 16


@pytest.mark.parametrize("packed", ["rle", "y12"])
def test_depth_that_the_sdk_unpacks_is_taken(plug: Plug, packed: str) -> None:
    # All that a Gemini 2 (RLE, Y14) or an Astra Mini Pro (Y12) has; frames come as Y16.
    camera = FakeCamera("1", {DEPTH: [profile(packed)]}, [Images(image(70))])
    plug(camera)
    (frame,) = orbbec(keep="every", stop=1)
    np.testing.assert_allclose(frame.depth, np.full((6, 8), 70 * 0.25e-3))


@pytest.mark.parametrize("model", ["brown_conrady", "brown_conrady_k6", None])
def test_the_cameras_lens_becomes_opencvs(plug: Plug, model: str | None) -> None:
    plug(FakeCamera("1", {DEPTH: [profile("y16", lens=LENS, model=model)]}))
    found = orbbec().camera.distortion
    np.testing.assert_array_equal(found, (*LENS[:2], *LENS[6:], *LENS[2:6]))


def test_other_lenses_are_a_fisheye_none_or_reported(plug: Plug) -> None:
    plug(FakeCamera("1", {DEPTH: [profile("y16", lens=LENS, model="kannala_brandt4")]}))
    camera = orbbec().camera
    assert camera.lens == "fisheye"
    np.testing.assert_array_equal(camera.distortion, LENS[:4])
    plug(FakeCamera("1", {DEPTH: [profile("y16", lens=LENS, model="none")]}))
    assert not orbbec().camera.distortion.any()
    plug(FakeCamera("1", {DEPTH: [profile("y16", model="inverse_brown_conrady")]}))
    assert not orbbec().camera.distortion.any()
    plug(FakeCamera("1", {DEPTH: [profile("y16", lens=LENS, model="inverse_brown_conrady")]}))
    with pytest.raises(ToftrackError, match="inverse_brown_conrady.*camera.file=FILE"):
        orbbec()


def test_a_missing_or_strange_sdk_is_reported_with_the_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for module in (None, ModuleType("pyorbbecsdk")):
        monkeypatch.setitem(sys.modules, "pyorbbecsdk", module)
        with pytest.raises(ToftrackError, match=r'pyorbbecsdk2.*"toftrack\[orbbec\]".*--no-deps'):
            orbbec()
