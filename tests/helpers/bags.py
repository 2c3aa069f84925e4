"""ROS bags for the tests, written by rosbags itself: skip where it is not installed."""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from toftrack.frames.camera import Camera

DEPTH = "/camera/depth/image_raw"
INFO = "/camera/depth/camera_info"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
KINDS = ("bag", "db3", "mcap")
START_NS = 1_700_000_000_000_000_000


@dataclass
class Message:
    """What is written: a topic, a type, the fields beside the header, and when it is recorded: 7 ms
    after its stamp.
    """

    topic: str
    kind: str
    fields: dict[str, Any]
    recorded_ns: int


def write_bag(folder: Path, kind: str, messages: Iterable[Message]) -> Path:
    """A bag of the kind `bag` (ROS 1), `db3` or `mcap` (ROS 2); returns its path."""
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    one = kind == "bag"
    types = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    if one:
        path = folder / "hand.bag"
        writer = Writer1(path)
    else:
        path = folder / kind
        plugin = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
        writer = Writer2(path, version=9, storage_plugin=plugin)
    connections: dict[str, Any] = {}
    with writer:
        for message in messages:
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.kind, typestore=types
                )
            content = _message(types, message, one)
            serialise = types.serialize_ros1 if one else types.serialize_cdr
            data = serialise(content, message.kind)
            writer.write(connections[message.topic], message.recorded_ns, data)
    return path


def _message(types: Any, message: Message, one: bool) -> Any:
    stamp_ns = message.recorded_ns - 7_000_000
    time = types.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    header = {"seq": 0} if one else {}
    header_type = types.types["std_msgs/msg/Header"]
    fields = dict(message.fields)
    if message.kind == CAMERA_INFO:
        fields["roi"] = types.types["sensor_msgs/msg/RegionOfInterest"](**fields["roi"])
        if not one:
            fields = {key.lower() if len(key) == 1 else key: v for key, v in fields.items()}
    whole = header_type(**header, stamp=time, frame_id="depth")
    return types.types[message.kind](header=whole, **fields)


def recorded_ns(number: int) -> int:
    """When the frame of that number is recorded."""
    return START_NS + round(number * 1e9 / 25)


def image(depth: np.ndarray, encoding: str = "16UC1", big: bool = False, pad: int = 0) -> dict:
    """The fields of an Image of depths in metres; `pad` bytes follow each row."""
    kind = {"16UC1": "u2", "32FC1": "f4", "rgb8": "u1"}[encoding]
    words = np.rint(1000 * depth.astype(float)) if kind == "u2" else depth
    rows = np.ascontiguousarray(words.astype(np.dtype(kind).newbyteorder(">" if big else "<")))
    data = rows.view(np.uint8).reshape(len(depth), -1)
    data = np.pad(data, ((0, 0), (0, pad)), constant_values=255)
    return {
        "height": depth.shape[0],
        "width": depth.shape[1],
        "encoding": encoding,
        "is_bigendian": int(big),
        "step": data.shape[1],
        "data": data.ravel(),
    }


def compressed(depth: np.ndarray, words: str = "16UC1; compressedDepth png") -> dict:
    """The fields of a CompressedImage as image_transport's compressedDepth writes them."""
    header = struct.pack("<iff", 0, 0.0, 0.0)
    pixels = np.rint(1000 * depth.astype(float)).astype(np.uint16)
    if words.startswith("32FC1"):
        a = 100.0 * 101.0
        b = 1.0 - a / 10.0
        header = struct.pack("<iff", 1, a, b)
        with np.errstate(divide="ignore"):
            pixels = np.where(depth > 0, np.rint(a / depth + b), 0).astype(np.uint16)
    packed = rvl(pixels) if words.endswith("rvl") else cv2.imencode(".png", pixels)[1].tobytes()
    data = header + packed
    return {"format": words, "data": np.frombuffer(data, np.uint8)}


def rvl(pixels: np.ndarray) -> bytes:
    """(H, W) uint16 as RVL packs them, number by number."""
    values, numbers, at, before = pixels.ravel().tolist(), [], 0, 0
    while at < len(values):
        for of_zeros in (True, False):
            end = next((i for i in range(at, len(values)) if (values[i] == 0) != of_zeros), None)
            end = len(values) if end is None else end
            numbers.append(end - at)
            for value in values[at:end] if not of_zeros else ():
                step, before = value - before, value
                numbers.append(2 * step if step >= 0 else -2 * step - 1)
            at = end
    nibbles = ""
    for number in numbers:
        while number > 7:
            nibbles, number = nibbles + f"{8 + number % 8:x}", number // 8
        nibbles += f"{number:x}"
    nibbles += "0" * (-len(nibbles) % 8)
    words = [int(nibbles[i : i + 8], 16) for i in range(0, len(nibbles), 8)]
    return struct.pack(f"<II{len(words)}I", *pixels.shape[::-1], *words)


def camera_info(camera: Camera, model: str = "plumb_bob", **changes: Any) -> dict:
    """The fields of a CameraInfo, those of the matrices with capital letters."""
    P = np.hstack((camera.K, np.zeros((3, 1))))
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    return {
        "height": camera.height,
        "width": camera.width,
        "distortion_model": model,
        "D": np.array(camera.distortion),
        "K": np.array(camera.K).ravel(),
        "R": np.eye(3).ravel(),
        "P": P.ravel(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": roi,
    } | changes


def recording(
    depth: Sequence[np.ndarray], camera: Camera, encoding: str = "16UC1", info_at: int = 0
) -> list[Message]:
    """Images and their camera_info, which comes before the image `info_at`."""
    messages = []
    for number, frame in enumerate(depth):
        at = recorded_ns(number)
        if number == info_at:
            messages.append(Message(INFO, CAMERA_INFO, camera_info(camera), at))
        if "compressedDepth" in encoding:
            topic, kind, fields = (
                f"{DEPTH}/compressedDepth",
                COMPRESSED,
                compressed(frame, encoding),
            )
        else:
            topic, kind, fields = DEPTH, IMAGE, image(frame, encoding)
        messages.append(Message(topic, kind, fields, at))
    return messages
