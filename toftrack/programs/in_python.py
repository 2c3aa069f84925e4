"""What `toftrack track` does, in a program of one's own: `toftrack.track`, and its results."""

from __future__ import annotations

import atexit
import json
import os
import shutil
import tempfile
import time
from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

import numpy as np
from hydra.utils import instantiate
from omegaconf import DictConfig

from toftrack.configuration.compose import configuration, one_sentence
from toftrack.devices.base import BaseDevice, frames_of
from toftrack.errors import ToftrackError, module_of_extra, reported_errors
from toftrack.files.archives import write_archive
from toftrack.files.safe_files import whole_file
from toftrack.frames.estimate import Estimate
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.lines import KINDS, json_line
from toftrack.output.records import facts_for_readers
from toftrack.output.results import ResultWriter, UnwritableError, estimates_of, read_results
from toftrack.output.stream import ReaderGoneError
from toftrack.programs.applications import with_recording
from toftrack.programs.export import csv_lines, table_of

if TYPE_CHECKING:
    import pandas

_Tracked = Generator[tuple[tuple[Estimate, ...], tuple[Estimate, ...]]]
_left_open: WeakSet[_Tracked] = WeakSet()
"""Loops that a program may have left without an end, as one that keeps `iter(track(...))`."""


@atexit.register
def _close_loops() -> None:
    """Close them while there still are the threads that servers and recorders wait for."""
    with ExitStack() as stack:  # all of them, also where one cannot finish its files
        for frames in tuple(_left_open):
            # No new thread any more; one that is in it.
            stack.enter_context(suppress(RuntimeError, ValueError))
            stack.callback(frames.close)


def track(
    source: str | os.PathLike[str] | BaseDevice,
    *overrides: str,
    config_dir: str | Path | None = None,
) -> Tracking:
    """Track the hands of a recording or camera, as `toftrack track` with the same words does.

        for estimate in toftrack.track("hand.npz", "hands=2"):
            print(estimate)
        toftrack.track("device=realsense", "device.stop=300").results().save("track.npz")

    No files are written and nothing is shown, unless an override says so: stream=udp, view=browser,
    record=FILE.npz; view=video puts its files into the working folder.

    source: a recording's name, an override that chooses a device ("device=sample"), or a device.
    overrides: as on the command line.  config_dir: as for make_tracker.

    Raises ToftrackError, as do the iteration and `results`: an override cannot be used, the device
    cannot deliver, or an override speaks of the device that was given.
    """
    if isinstance(source, BaseDevice):
        for word in overrides:
            if word.lstrip("+~").startswith(("device=", "device.")):
                raise ToftrackError(
                    f"{word} says where frames come from, but track was given a device, a "
                    f"{type(source).__name__}; leave one out"
                )
        return Tracking(configuration("view=none", *overrides, config_dir=config_dir), source)
    if not isinstance(source, str | os.PathLike):
        raise ToftrackError(
            f"track takes the name of a recording, or a device, but not {type(source).__name__}; "
            "images of your own go to make_tracker().step, or into a PushDevice"
        )
    words = with_recording([os.fspath(source), *overrides], [str(config_dir)] if config_dir else [])
    config = configuration("view=none", *words, config_dir=config_dir)
    with one_sentence():
        return Tracking(config, instantiate(config.device))


class Tracking:
    """The hands of a device, made by `track`: iterate over it for an Estimate of each frame, or
    take all `results`. Both begin with a new tracker, and close the device when they end or fail.

    With hands=N a frame has N estimates, one a slot, in turn; that of an empty slot is lost. All
    frames of a recording are tracked; a live camera's are dropped where they come too late.
    """

    def __init__(self, config: DictConfig, device: BaseDevice) -> None:
        self._config = config
        self._metadata: dict[str, Any] = {}
        self.device = device
        """What delivers the frames."""
        self.camera = device.camera
        """Of the newest estimate."""
        self.depth_m: np.ndarray = np.zeros((0, 0), np.float32)
        """(H, W) metres, 0 = no reading: the rectified image of the newest estimate."""

    def __iter__(self) -> Iterator[Estimate]:
        for _, smoothed in self._frames():
            yield from smoothed

    def results(self) -> Results:
        """Track to the end, or, of a live camera, to device.stop=N or Ctrl-C, and keep everything;
        meanwhile on the disk. As in a run's files, nothing is smoothed unless smooth.results=true.
        Raises ToftrackError when there was no frame.
        """
        with closing(self._frames()) as frames, _scratch_folder() as folder:
            if (first := next(frames, None)) is None:
                raise ToftrackError("the device delivered no frame; nothing was tracked")
            with ResultWriter(folder, self._metadata, JOINT_NAMES) as writer:
                try:
                    for estimates, _ in chain((first,), frames):
                        writer.append(estimates)
                except KeyboardInterrupt:
                    if not self.device.live:
                        raise
            return Results(read_results(folder / "track.npz"))

    def _frames(self) -> _Tracked:
        """Of each frame the estimates, and smoothed."""
        _left_open.add(frames := self._followed())
        return frames

    def _followed(self) -> _Tracked:
        from toftrack.programs.track import prepared_run, run_metadata  # takes seconds

        config, device = self._config, self.device
        with one_sentence(), suppress(ReaderGoneError), prepared_run(config, device) as run, device:
            self._metadata = run_metadata(config, device, run.tracker)
            make_view = instantiate(config.view, _partial_=True)
            with make_view(folder=Path(), fps=device.fps, frames=device.frames) as view:
                for frame in frames_of(device):
                    tracked, smoothed = run.frame(frame, time.perf_counter(), view)
                    self.camera, self.depth_m = tracked.camera, tracked.depth_m
                    yield tracked.estimates, smoothed


@contextmanager
def _scratch_folder() -> Iterator[Path]:
    """A folder that is gone afterwards, but for that of a run which says how to recover it."""
    remedy = "set TMPDIR to a folder that can be written"
    with reported_errors("there is no temporary folder for the results", remedy):
        folder = Path(tempfile.mkdtemp(prefix="toftrack-"))
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        try:
            yield folder
        except UnwritableError:
            stack.pop_all()
            raise


@dataclass(frozen=True, eq=False, repr=False)
class Results:
    """T tracked frames as arrays, those of track.npz: the fields of Estimate, each with a row a
    frame, `joints_m` (T, 21, 3), `lost` (T,), and `dropped` (T,), a live camera's frames that came
    too late. With hands=N what is said of a hand has an axis of N slots: (T, N, 21, 3), (T, N).
    """

    content: dict[str, Any]
    """The arrays by name, `joint_names` and `metadata`, as `read_results(FILE)` gives them."""

    def __getattr__(self, name: str) -> np.ndarray:
        value = vars(self).get("content", {}).get(name)
        if not isinstance(value, np.ndarray):
            raise AttributeError(f"Results has no array {name!r}; it has {', '.join(KINDS)}")
        return value

    def __dir__(self) -> list[str]:
        arrays = (name for name, it in self.content.items() if isinstance(it, np.ndarray))
        return sorted({*super().__dir__(), *arrays})

    def __repr__(self) -> str:
        slots = f"{self.lost.shape[1]} slots, " if self.lost.ndim > 1 else ""
        return f"<Results: {len(self.lost)} frames, {slots}{self.lost.mean():.0%} lost>"

    def estimates(self, row: int) -> tuple[Estimate, ...]:
        """Those of a row's frame, one a slot."""
        return estimates_of(self.content, row)

    def draw(self, image: np.ndarray, row: int) -> np.ndarray:
        """The image of a row's frame with the skeletons; see `toftrack.draw`."""
        from toftrack.views.overlay import draw  # takes seconds

        camera = self.content["metadata"].get("camera") or {}
        return draw(image, self.estimates(row), np.array(camera.get("K")))

    def save(self, path: str | Path) -> None:
        """Write a file as a run has it, by its suffix: .npz is track.npz, .jsonl track.jsonl, .csv
        the table of `toftrack export`. Raises ToftrackError where that cannot be.
        """
        path, content = Path(path).expanduser(), self.content
        with reported_errors(f"'{path}' cannot be written", "give a file in another folder"):
            if path.suffix == ".npz":
                texts = {"metadata": np.array(json.dumps(content["metadata"]))}
                write_archive(path, content | texts | facts_for_readers(content["metadata"]))
            elif path.suffix == ".csv":
                with whole_file(path) as stream:
                    stream.writelines(csv_lines(content))
            elif path.suffix == ".jsonl":
                rows = np.flatnonzero(~self.dropped).tolist()
                lines = (f"{json_line(self.estimates(row))}\n".encode() for row in rows)
                with whole_file(path) as stream:
                    stream.writelines(lines)
            else:
                raise ToftrackError(f"'{path}' names no format; let it end in .npz, .jsonl or .csv")

    def to_pandas(self) -> pandas.DataFrame:
        """The table of .csv files. Raises ToftrackError where pandas is not installed."""
        pandas = module_of_extra("pandas", "to_pandas needs the package pandas", "pandas")
        titles, *rows = table_of(self.content)
        return pandas.DataFrame(rows, columns=titles)
