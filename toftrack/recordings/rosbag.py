"""ROS bags, by the library rosbags: `.bag` of ROS 1, `.mcap`, `.db3` and folders of ROS 2.

One topic of depth images is played, with the lens that its camera_info tells. A bag is read through
once for the times, and then again, message by message: long ones need no more memory than short
ones. What is read of each message stands in `ros_messages.py`.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.safe_files import check_readable
from toftrack.frames.camera import Camera
from toftrack.recordings.bare import MILLIMETRE, NOTHING_GIVEN, Given, check_metres
from toftrack.recordings.frame_store import FrameStore, rate_of
from toftrack.recordings.ros_messages import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    camera_of,
    depth_image,
    encoding,
    is_depth,
)

_SUFFIXES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"
_REPAIR = {
    ".bag": "rosbag reindex FILE repairs a bag that was cut off",
    ".mcap": "mcap recover FILE repairs one that was cut off",
    ".db3": "record or copy it again",
    "": "ros2 bag reindex FOLDER repairs one that was cut off",
}
_OTHER_UNIT = (
    ": 32FC1 must be metres, and of 16UC1 one step is told by device=rosbag device.unit_m="
)
_OF_CAMERAS = {"/device_0/sensor_": "realsense", "/cam/sensor_": "orbbec"}
"""How topics begin in the bags that cameras' own programs write, and the devices that play them."""


def is_bag(path: str | Path) -> bool:
    """A file `.bag` (ROS 1), `.mcap` or `.db3` (ROS 2), or the folder of a ROS 2 bag."""
    if os.path.isdir(path):
        return os.path.exists(os.path.join(path, _METADATA)) or bool(_storages(Path(path)))
    return os.path.splitext(path)[1].lower() in _SUFFIXES


def _storages(folder: Path) -> list[Path]:
    """The files with messages of a ROS 2 bag's folder; none where it cannot be read."""
    try:
        return sorted(path for path in folder.iterdir() if path.suffix in _SUFFIXES[1:])
    except OSError:
        return []


class RosBag(FrameStore):
    """The depth images of one topic, from the disk one at a time; its times are read at once.

    path: a `.bag`, `.mcap` or `.db3`, or the folder of a ROS 2 bag.  given: a lens instead of the
    bag's camera_info; the topic of the depth images, None = the only one there is; metres of one
    step of 16UC1, None = a millimetre, as ROS says.
    """

    unit_m: float

    def __init__(self, path: Path, given: Given = NOTHING_GIVEN) -> None:
        if not path.exists():
            raise ToftrackError(f"there is no bag '{path}'; give the path of a recording")
        with reported_errors(f"the bag '{path}' cannot be read", "give the path of a recording"):
            check_readable(path)
        self.path, self.unit_m = path, given.unit_m or MILLIMETRE
        bag = self._bag = _Bag(path)
        self._messages: Iterator[tuple[int, Any]] | None = None
        self._next = 0
        with closing(bag):
            topic = self._topic = _choose(bag, given.topic)
            first = self._metres(topic.first, 0)
            what = f"the first image of {topic.name} in '{path}'"
            check_metres(first, what, _OTHER_UNIT)
            height, width = first.shape
            self.camera = given.camera(width, height, what) or _camera(bag, topic)
            self.camera.check_size(first, what)  # its lens would take that much memory
            self.timestamp_s, self._recorded_ns, self.damage = _times(bag, topic)
        self.fps = rate_of(self.timestamp_s)
        self.metadata = {"topic": topic.name, "encoding": topic.encoding}

    def image(self, index: int) -> tuple[np.ndarray, None]:
        if self._messages is None or index != self._next:
            self._messages = self._from(index)
        _, message = next(self._messages, (0, None))
        if message is None:
            raise ToftrackError(f"'{self.path}' ended while it was read; is it still being copied?")
        self._next = index + 1
        depth = self._metres(message, index)
        self.camera.check_size(depth, f"frame {index} of '{self.path}'")
        return depth, None

    def close(self) -> None:
        self._messages = None
        self._bag.close()

    def _metres(self, message: Any, index: int) -> np.ndarray:
        try:
            return depth_image(message, self._topic.kind, self.unit_m)
        except ToftrackError as error:
            raise ToftrackError(
                f"image {index} of the topic {self._topic.name} in '{self.path}' cannot be used: "
                f"{error}"
            ) from None

    def _from(self, index: int) -> Iterator[tuple[int, Any]]:
        start_ns = int(self._recorded_ns[index])
        messages = self._bag.messages(self._topic.name, self._topic.kind, start_ns)
        # Several messages may have been recorded at the same time.
        return islice(messages, index - int(np.searchsorted(self._recorded_ns, start_ns)), None)


@dataclass(frozen=True, eq=False)
class _Topic:
    """A topic of images."""

    name: str
    kind: str
    """IMAGE or COMPRESSED."""
    encoding: str
    first: Any
    """Its first message."""

    @property
    def base(self) -> str:
        """The topic without what image_transport appends for a compression."""
        return self.name.rpartition("/")[0] if self.kind == COMPRESSED else self.name


class _Bag:
    """A bag as rosbags reads it, opened when it is needed; its errors are sentences."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._is_one = path.suffix.lower() == ".bag" and path.is_file()
        try:
            self._rosbags = importlib.import_module(f"rosbags.rosbag{1 if self._is_one else 2}")
            types = importlib.import_module("rosbags.typesys")
        except ImportError as error:
            raise ToftrackError(
                f"'{path}' is read by rosbags ({error}): pip install \"toftrack[ros]\" (or, if a "
                "camera's own program wrote it, device=realsense or orbbec with device.bag=FILE)"
            ) from error
        # The messages that are read are the same in every release of ROS 2.
        store = types.Stores.ROS1_NOETIC if self._is_one else types.Stores.ROS2_HUMBLE
        self._types = types.get_typestore(store)
        self._reader: Any = None

    def reader(self) -> Any:
        if self._reader is None:
            path = self.path
            # A folder whose metadata was never written is its only file.
            if path.is_dir() and not (path / _METADATA).exists() and len(_storages(path)) == 1:
                (path,) = _storages(path)
            with self._reported():
                reader = self._rosbags.Reader(path)
                reader.open()
            self._reader = reader
        return self._reader

    def close(self) -> None:
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()

    def firsts(self, kind: str) -> Iterator[tuple[str, Any]]:
        """The topics of a type of messages that hold any, each with its first one."""
        connections = self.reader().connections
        for name in sorted({c.topic for c in connections if c.msgtype == kind and c.msgcount}):
            for _, first in islice(self.messages(name, kind), 1):
                yield name, first

    def messages(self, name: str, kind: str, start_ns: int = 0) -> Iterator[Any]:
        """When recorded, ns, and the message, of a topic and type, from then on."""
        reader = self.reader()
        connections = [c for c in reader.connections if (c.topic, c.msgtype) == (name, kind)]
        parse = self._types.deserialize_ros1 if self._is_one else self._types.deserialize_cdr
        with self._reported():
            for _, recorded_ns, data in reader.messages(connections, start=start_ns or None):
                yield recorded_ns, parse(data, kind)

    def _reported(self) -> AbstractContextManager[None]:
        """What rosbags says of a damaged bag becomes one sentence; it raises errors of any kind."""
        repair = _REPAIR[self.path.suffix.lower() if self.path.is_file() else ""]
        what = f"the bag '{self.path}' cannot be read"
        return reported_errors(what, f"it is damaged or no bag: {repair}", Exception)


def _choose(bag: _Bag, wanted: str | None) -> _Topic:
    """The topic of depth images; ToftrackError, with those there are, where it is not clear."""
    for start, device in _OF_CAMERAS.items():
        if any(connection.topic.startswith(start) for connection in bag.reader().connections):
            raise ToftrackError(
                f"'{bag.path}' is a recording of a camera's own program, which only that can read: "
                f"play it with device={device} device.bag=FILE"
            )
    images = [
        _Topic(name, kind, encoding(first, kind), first)
        for kind in (IMAGE, COMPRESSED)
        for name, first in bag.firsts(kind)
    ]
    if wanted is not None:
        for topic in images:
            if topic.name == "/" + wanted.strip("/") or topic.name == wanted:
                return topic
        raise ToftrackError(
            f"'{bag.path}' has no images of the topic {wanted}; its image topics are "
            f"{_listed(images)}"
        )
    depth = [topic for topic in images if is_depth(topic.encoding)]
    raw = {topic.base for topic in depth if topic.kind == IMAGE}
    # What image_transport compressed is there twice: once is enough.
    depth = [topic for topic in depth if topic.kind == IMAGE or topic.base not in raw]
    if not depth:
        raise ToftrackError(
            f"'{bag.path}' has no depth images (16UC1, 32FC1, or compressedDepth); its image "
            f"topics are {_listed(images)}"
        )
    if len(depth) > 1:
        raise ToftrackError(
            f"'{bag.path}' has {len(depth)} topics of depth images; choose one with device=rosbag "
            f"device.topic=TOPIC (toftrack convert: --topic): {_listed(depth)}"
        )
    return depth[0]


def _listed(topics: list[_Topic]) -> str:
    return ", ".join(f"{topic.name} ({topic.encoding})" for topic in topics) or "none"


def _camera(bag: _Bag, topic: _Topic) -> Camera:
    """The lens of a topic's images: its camera_info, wherever in the bag that comes."""
    sibling = f"{topic.base.rpartition('/')[0]}/camera_info"
    infos = dict(bag.firsts(CAMERA_INFO))
    if sibling not in infos:
        frame = topic.first.header.frame_id
        fitting = [name for name, info in infos.items() if frame and info.header.frame_id == frame]
        if len(fitting) != 1:
            raise ToftrackError(
                f"'{bag.path}' has no message of {sibling}, which tells the lens of {topic.name} "
                f"(there are {', '.join(infos) or 'none'}); record it, too, or give a camera with "
                "camera.file=FILE"
            )
        sibling = fitting[0]
    try:
        return camera_of(infos[sibling], rectified="rect" in topic.base.rpartition("/")[2])
    except ToftrackError as error:
        raise ToftrackError(
            f"{sibling} of '{bag.path}' cannot be used as camera: {error}"
        ) from None


def _times(bag: _Bag, topic: _Topic) -> tuple[np.ndarray, np.ndarray, str | None]:
    """Of a topic's messages, up to where the bag can be read: (T,) seconds when the images were
    taken, by their own stamps (when recorded, where those make no sense); (T,) int64 nanoseconds
    when recorded, not decreasing, by which messages are found; and what ended the bag too early.
    """
    stamps: list[int] = []
    recorded: list[int] = []
    damage = None
    try:
        for recorded_ns, message in bag.messages(topic.name, topic.kind):
            if recorded and recorded_ns < recorded[-1]:
                raise ToftrackError(f"the messages of '{bag.path}' are out of order")
            stamp = message.header.stamp
            stamps.append(int(stamp.sec) * 10**9 + int(stamp.nanosec))
            recorded.append(recorded_ns)
    except ToftrackError as error:
        if not stamps:
            raise
        damage = str(error)
    taken = np.array(stamps, np.int64)
    # Some drivers leave the stamps empty, or count them by two clocks.
    sound = taken[0] > 0 and (np.diff(taken) >= 0).all() and (len(taken) < 2 or np.ptp(taken) > 0)
    recorded_at = np.array(recorded, np.int64)
    return (taken if sound else recorded_at) / 1e9, recorded_at, damage
