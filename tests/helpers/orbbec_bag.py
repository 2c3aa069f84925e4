"""A recording as Orbbec's SDK writes it: a bag of ROS 1 with messages of its own."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from toftrack.frames.camera import Camera

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
