"""A ROS bag played back as if it were a camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.recordings.rosbag import read_rosbag


class Bag(Replay):
    """The depth images of one topic of a bag, as `Replay`.

    Args:
        path: a `.bag`, `.mcap` or `.db3`, or a folder with metadata.yaml.
        topic: of the depth images; None = the only one there is.
        unit_m: metres of one step of 16UC1; None = a millimetre, as ROS says.
        camera_file, start, stop, realtime, repeat: as for `Replay`.

    Raises:
        ToftrackError: as `Replay`, and as `read_rosbag`.
    """

    def __init__(
        self,
        path: str | Path,
        topic: str | None = None,
        unit_m: float | None = None,
        camera_file: str | Path | None = None,
        **playback: Any,
    ) -> None:
        if not path:
            raise ToftrackError("no bag was given; set device.path=BAG")
        store = read_rosbag(path, topic, camera_file, unit_m)
        super().__init__(path, camera_file=camera_file, store=store, **playback)
        self.description |= {"device": "rosbag", **store.metadata, "unit_m": store.unit_m}
