"""Orbbec's SDK itself plays a recording; skipped where the SDK cannot be loaded."""

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.settings import orbbec
from helpers.tracking import ROOT
from helpers.videos import RATIONAL

from toftrack.devices.orbbec.device import load_sdk
from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera

CAMERA = Camera(np.array([[252.0, 0, 165], [0, 253, 150], [0, 0, 1]]), 320, 288, RATIONAL)
COUNT = 10


@pytest.fixture(scope="module", autouse=True)
def _sdk() -> None:
    try:
        load_sdk()
    except ToftrackError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    """(2, COUNT, 288, 320) uint16: depth and infrared."""
    return np.random.default_rng(0).integers(1, 9000, (2, COUNT, 288, 320)).astype(np.uint16)


@pytest.fixture(scope="module")
def recording(images: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_orbbec_bag(tmp_path_factory.mktemp("orbbec") / "a.bag", *images, CAMERA)


def test_a_recording_gives_what_the_sdk_recorded(recording: Path, images: np.ndarray) -> None:
    device = orbbec(bag=recording, keep="every")
    np.testing.assert_allclose(device.camera.K, CAMERA.K)
    np.testing.assert_allclose(device.camera.distortion, CAMERA.distortion, rtol=1e-6)
    assert device.fps == 30
    assert device.description["serial"] == "CL8042"
    frames = list(device)
    assert frames and frames[0].index == 0
    # On a busy machine the SDK may begin with a later frame than the recording's first.
    missed = round(30 * (frames[0].timestamp_s - 1))
    for frame in frames:
        number = missed + frame.index
        np.testing.assert_allclose(frame.depth, images[0, number] / 1000, rtol=1e-6)
        np.testing.assert_array_equal(frame.amplitude, images[1, number])
        assert frame.timestamp_s == pytest.approx(1 + number / 30, abs=1e-5)
    assert missed + frames[-1].index == len(images[0]) - 1, "to the end"


def test_what_is_no_recording_is_reported(tmp_path: Path, recording: Path) -> None:
    for content in (b"", b"nonsense" * 50, recording.read_bytes()[:9000]):
        (tmp_path / "a.bag").write_bytes(content)
        with pytest.raises(ToftrackError, match="a.bag' is not a recording of an Orbbec camera"):
            orbbec(bag=tmp_path / "a.bag")


def test_as_a_bag_of_ros_it_is_refused_with_whose_it_is(recording: Path) -> None:
    with pytest.raises(ToftrackError, match="device=orbbec device.bag="):
        Replay(recording)


def test_the_sdk_leaves_standard_output_and_the_folder_alone(tmp_path: Path) -> None:
    code = (
        "from toftrack.devices.orbbec.device import load_sdk; load_sdk().Context(); print('mine')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": ":".join([str(ROOT), *filter(None, sys.path)])},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (0, "mine\n")
    assert not list(tmp_path.iterdir())


_DEPTH, _INFRARED = 3, 1
"""Numbers of the sensors, their streams and frames."""
_Y16 = 8
_RATIONAL = 4
"""The SDK's number of the lens model BROWN_CONRADY_K6."""
_HEADER = "std_msgs/Header header\n"


def write_orbbec_bag(
    path: Path, depth: np.ndarray, infrared: np.ndarray, camera: Camera, fps: int = 30
) -> Path:
    """(T, H, W) uint16 images, steps of a millimetre; the camera's 8 coefficients go with them."""
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    from rosbags.rosbag1 import Writer

    with Writer(path) as writer:

        def connect(topic: str, kind: str, digest: str) -> object:
            return writer.add_connection(topic, kind, msgdef=_HEADER, md5sum=digest)

        version = connect("/cam/property", "custom_msg/msg/OBProperty", _OWN_MD5)
        about = connect("/cam/deviceInfo", "custom_msg/msg/OBDeviceInfo", _INFO_MD5)
        profiles = [
            connect(f"/cam/streamProfileType_{n}", "custom_msg/msg/OBStreamProfileInfo", _OWN_MD5)
            for n in (_DEPTH, _INFRARED)
        ]
        images = [
            connect(f"/cam/sensor_{n}/frameType_{n}", "sensor_msgs/msg/Image", _IMAGE_MD5)
            for n in (_DEPTH, _INFRARED)
        ]
        begin_ns = 1_000_000_000
        writer.write(version, begin_ns, _version(begin_ns))
        writer.write(about, begin_ns, _device(begin_ns))
        for connection, stream in zip(profiles, (_DEPTH, _INFRARED), strict=True):
            writer.write(connection, begin_ns, _profile(begin_ns, stream, camera, fps))
        for number in range(len(depth)):
            time_ns = begin_ns + round(number * 1e9 / fps)
            for connection, words in zip(images, (depth, infrared), strict=True):
                writer.write(connection, time_ns, _image(time_ns, number, words[number]))
    return path


_INFO_MD5 = "afef5328bb4abebd1a309e1ea8b26b3a"
_OWN_MD5 = "0123456789abcdef0123456789abcdef"
_IMAGE_MD5 = "060021388200f6f0f447d0fcd9c64743"


def _header(time_ns: int) -> bytes:
    return struct.pack("<III", 0, *divmod(time_ns, 10**9)) + _text("")


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _version(time_ns: int) -> bytes:
    """The property 0: the version of the format."""
    return _header(time_ns) + struct.pack("<II", 0, 8) + struct.pack("<dI", 2.1, 8)


def _device(time_ns: int) -> bytes:
    names = b"".join(map(_text, ("Femto Bolt", "Orbbec Femto Bolt", "asic")))
    ids = struct.pack("<HH", 0x2BC5, 0x066B)
    more = b"".join(map(_text, ("uid", "CL8042", "1.0.9", "1.0", "2.0.0", "USB3.0")))
    return _header(time_ns) + names + ids + more + struct.pack("<HB", 0, 0) + 2 * _text("")


def _profile(time_ns: int, stream: int, camera: Camera, fps: int) -> bytes:
    k1, k2, p1, p2, k3, k4, k5, k6 = camera.distortion
    K = camera.K
    return (
        _header(time_ns)
        + struct.pack("<BB12f", stream, _Y16, *np.eye(3).ravel(), 0, 0, 0)
        + struct.pack("<HHH", camera.width, camera.height, fps)
        + struct.pack("<4f", K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        + struct.pack("<8fB", k1, k2, k3, k4, k5, k6, p1, p2, _RATIONAL)
    )


def _image(time_ns: int, number: int, words: np.ndarray) -> bytes:
    data = words.astype("<u2").tobytes()
    height, width = words.shape
    time_us = time_ns // 1000
    return (
        _header(time_ns)
        + struct.pack("<II", height, width)
        + _text("mono16")
        + struct.pack("<BII", 0, 2 * width, len(data))
        + data
        + struct.pack("<f4Q", 1.0, number, time_us, time_us, time_us)
        + struct.pack("<II", 0, 0)
        + struct.pack("<B", 16)
    )
