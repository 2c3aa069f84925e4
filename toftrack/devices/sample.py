"""The recording that comes with the package."""

from __future__ import annotations

from pathlib import Path

from toftrack.devices.replay import Replay
from toftrack.recordings.store import packaged_sample


class Sample(Replay):
    """A right hand for 100 frames, with ground truth; arguments and errors as for `Replay`."""

    def __init__(
        self,
        start: int = 0,
        stop: int | None = None,
        realtime: bool = False,
        repeat: bool = False,
        camera_file: str | Path | None = None,
    ) -> None:
        with packaged_sample() as path:
            super().__init__(path, start, stop, realtime, repeat, camera_file)
        # Where the package happens to be installed says nothing about the result.
        self.description |= {"device": "sample", "recording": "toftrack/data/sample.npz"}
