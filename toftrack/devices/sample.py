"""The recordings that come with the package."""

from __future__ import annotations

from typing import Any

from toftrack.devices.replay import Replay
from toftrack.recordings.store import FIRST_SAMPLE, packaged_sample, sample_file


class Sample(Replay):
    """A recording that comes with the package, with ground truth, by its name; without one a right
    hand for 100 frames. Other arguments and errors as for `Replay`.

    Raises ToftrackError for a name that no sample has; it lists them.
    """

    def __init__(self, name: str = FIRST_SAMPLE, **playback: Any) -> None:
        with packaged_sample(name) as path:
            super().__init__(path, **playback)
        # Where the package happens to be installed says nothing about the result.
        recording = f"toftrack/data/{sample_file(name)}"
        self.description |= {"device": "sample", "name": name, "recording": recording}
