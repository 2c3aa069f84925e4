"""The result files of a run: run.json, track.jsonl, track.npz and summary.json.

`run.json` is written at the start, `track.jsonl` grows by a line as each frame is done. The two
others are made when the writer is closed, or later, of the lines, if it never was.
"""

from __future__ import annotations

import datetime
import json
import os
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from toftrack.errors import MOST_HANDS, ToftrackError, check_format, reported_errors
from toftrack.files.archives import read_archive
from toftrack.files.json_text import parse_json, read_json, write_json
from toftrack.frames.estimate import Estimate
from toftrack.frames.frame import Truth
from toftrack.output.files import LINES, RUN_FORMAT, LineFile, make_way
from toftrack.output.lines import DROPPED, HAND_FIELDS, KINDS, SHAPES, json_line, strict
from toftrack.output.records import Records, facts_for_readers, write_results
from toftrack.output.summary import run_doubts, run_metrics, summarise

_VERSION = 1
_MOST_HELD = 10_000_000
"""Dropped frames between others, 4 days of them; more are none, but a damaged number."""
_MOST_DIMS = 100
_MOST_BYTES = 2**34
"""Of a track.npz, of which a hand takes 2.4 kB a frame: two hands for more than a day."""
_TEXTS = ("joint_names", "metadata")
_PARTS = ("camera", "config", "device", "hand_shape", "pose_space")
"""Of the metadata: what is said of each."""


class UnwritableError(ToftrackError):
    """The folder of a run cannot be written any more; what is in it may be recovered."""


class ResultWriter:
    """Writes a run's result files into a folder; use it with `with`.

    Frames that a device dropped leave gaps between the indices of the estimates. `track.npz` has a
    row for every frame of the input nevertheless: a dropped frame repeats the newest estimate there
    was, with no time spent on it, and `dropped` and the state's name say so.

    The folder is made, and locked until the writer is closed; the results of an earlier run in it
    go. metadata: facts about the run, JSON-able.  truth: adds `metrics` to the summary.

    Raises ToftrackError: the folder, or a file in it, cannot be written, another run is writing
    into it, or it has files of these names that are no run's.
    """

    def __init__(
        self,
        folder: str | Path,
        metadata: dict[str, Any],
        joint_names: Sequence[str],
        truth: Truth | None = None,
    ) -> None:
        self.folder = Path(folder)
        self.summary: dict[str, Any] | None = None
        """The content of summary.json once the writer is closed."""
        self.frames = 0
        """How many were appended."""
        self.realtime: RealTime | None = None
        """How a live run kept up, for summary.json; to be set before the writer is closed."""
        self.apparent_m: Sequence[float | None] = ()
        """Of Watch.apparent_m, for summary.json; to be set likewise."""
        self.complete = True
        """Whether nothing ended the run early; likewise."""
        self._truth = truth
        self._facts = {
            "format": RUN_FORMAT,
            "version": _VERSION,
            "started": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
            "working_folder": os.getcwd(),
            "truth": truth is not None,
            "joint_names": list(joint_names),
            "metadata": strict(metadata),
        }
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with ExitStack() as unless_done:
                self._lines = unless_done.enter_context(closing(LineFile(self.folder)))
                make_way(self.folder)
                self._lines.clear()
                write_json(self.folder / "run.json", self._facts)
                unless_done.pop_all()
        except OSError as error:
            raise self._unwritable(error) from error
        self._records: Records | None = None
        self._closed = False

    def append(self, estimates: Sequence[Estimate]) -> None:
        """Write the line of a frame, with an estimate for each slot, to disk; or ToftrackError."""
        try:
            self._lines.append(json_line(estimates))
            self.frames += 1
            if self._records is None:
                self._records = Records(self.folder, estimates[0].latent.size, len(estimates))
            self._records.append(estimates)
        except OSError as error:
            raise self._unwritable(error) from error

    def close(self) -> None:
        """Write track.npz and summary.json, or ToftrackError; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            with closing(self._records or records_of(self.folder, self._facts)) as records:
                realtime = None if self.realtime is None else self.realtime.summary()
                self.summary = finish(
                    *(self.folder, self._facts, self._truth, records),
                    *(self.complete, realtime, self.apparent_m),
                )
        except OSError as error:
            raise self._unwritable(error) from error
        finally:
            self._lines.close()

    def _unwritable(self, error: OSError) -> ToftrackError:
        reason, folder = error.strerror or error, self.folder
        if not self.frames:
            return ToftrackError(
                f"the output folder '{folder}' cannot be written ({reason}); choose another with "
                "hydra.run.dir=DIR"
            )
        if not folder.exists():
            return UnwritableError(
                f"the output folder '{folder}' was removed or renamed while the run went on; where "
                f"it is now, `toftrack recover` makes the files of the {self.frames} frames until "
                "then"
            )
        return UnwritableError(
            f"the output folder '{folder}' cannot be written any more ({reason}); the "
            f"{self.frames} frames until then are in its {LINES}: make room, or make it writable, "
            f"then `toftrack recover {folder}`"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.complete = self.complete and kind is None
        self.close()


def records_of(folder: Path, facts: dict[str, Any]) -> Records:
    """The records of a run's lines, which take a while to read; ToftrackError for damaged lines."""
    metadata = facts["metadata"]
    latent_size = (metadata.get("pose_space") or {}).get("dims", 4)
    slots = (metadata.get("config") or {}).get("hands", 1)
    if latent_size not in range(1, _MOST_DIMS + 1) or slots not in range(1, MOST_HANDS + 1):
        raise ToftrackError(
            f"'{folder / 'run.json'}' is damaged: a run does not follow {slots} hands in "
            f"{latent_size} dimensions"
        )
    return Records.of_lines(folder / LINES, latent_size, slots)


def finish(
    folder: Path,
    facts: dict[str, Any],
    truth: Truth | None,
    records: Records,
    complete: bool,
    realtime: dict[str, Any] | None = None,
    apparent_m: Sequence[float | None] = (),
) -> dict[str, Any]:
    """Make track.npz and summary.json of a run's frames; returns the summary. Raises OSError.

    facts: of run.json.  truth: of the run's frames, by their numbers.  complete: nothing ended the
    run early.  realtime: what summary.json says of a live run, and apparent_m, for run_doubts: the
    lines do not tell either.
    """
    metadata = facts["metadata"]
    rows, changed = _every_frame(records)
    dropped = changed[DROPPED]
    small = {
        "joint_names": np.array(facts["joint_names"], np.str_),
        "metadata": np.array(json.dumps(metadata)),
    } | facts_for_readers(metadata)
    summary = summarise(records, len(rows), int(dropped.sum()), folder, metadata)
    summary["complete"] = complete
    summary["doubts"] = run_doubts(records, folder, metadata, apparent_m)
    if realtime is not None:
        summary["realtime"] = realtime
    if truth is not None and len(rows):
        counted = ~dropped | bool((metadata.get("config") or {}).get("count_dropped"))
        metrics = run_metrics(records, rows, changed["index"], truth, counted)
        summary |= {"metrics": metrics} if metrics else {}
    write_results(folder / "track.npz", records, rows, changed | small)
    write_json(folder / "summary.json", strict(summary))
    return summary


def count_frames(records: Records) -> int:
    """How many rows the track.npz of these records has."""
    return len(_every_frame(records)[0])


def _every_frame(records: Records) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Which record each row of track.npz is, and the columns that are not copied: index,
    timestamp_s, compute_s and dropped, and state_name where frames were.
    """
    names = ("index", "timestamp_s", "compute_s")
    index, times, seconds = (records.column(name) for name in names)
    # Where the device counts anew there is nothing to fill in.
    every, rows = index, np.arange(len(index))
    counts_on = len(index) > 0 and (np.diff(index) >= 1).all()
    if counts_on and int(index[-1]) - int(index[0]) <= _MOST_HELD:
        every = np.arange(index[0], index[-1] + 1)
        rows = np.searchsorted(index, every, side="right") - 1
        times = np.interp(every, index, times)
    dropped = index[rows] != every
    changed = {
        "index": every,
        "timestamp_s": times,
        "compute_s": np.where(dropped, np.float32(0), seconds[rows]),
        DROPPED: dropped,
    }
    if dropped.any():
        states = records.column("state_name", rows)  # (T,) or (T, S)
        of_frame = dropped.reshape(-1, *(1,) * (states.ndim - 1))
        # A slot without a hand says nothing.
        changed["state_name"] = np.where(of_frame & (states != ""), DROPPED, states)
    return rows, changed


def read_results(path: str | Path) -> dict[str, Any]:
    """The content of a track.npz: its arrays, with those of `facts_for_readers` as they are now,
    `joint_names` as a tuple and `metadata` as a dict.

    Of a run with `hands=N` above 1 the arrays of what is said of hands have an axis of N slots
    behind that of the frames.

    Raises ToftrackError when the file is missing, damaged or not a result.
    """
    path = Path(path).expanduser()
    try:
        names = (*KINDS, DROPPED, *_TEXTS)
        what = f"the result file '{path}' cannot be read"
        with reported_errors(what, "give the path of a track.npz"):
            arrays = read_archive(path, set(names), _MOST_BYTES)
        content: dict[str, Any] = {name: arrays[name] for name in names}
        content["joint_names"] = tuple(content["joint_names"].tolist())
        content["metadata"] = parse_json(content["metadata"].item())
        if not _are_metadata(content["metadata"]):
            raise ValueError("the metadata are no objects")
        content |= facts_for_readers(content["metadata"])
        _check_arrays({name: arrays[name] for name in (*KINDS, DROPPED)})
    except KeyError as error:
        raise ToftrackError(
            f"'{path}' is not a track.npz of this toftrack (it has no "
            f"'{error.args[0]}'); track again, or use the version that made it"
        ) from None
    except (ValueError, TypeError, AttributeError) as error:
        raise ToftrackError(
            f"'{path}' is not a track.npz, or it is damaged ({error}); give the path of one"
        ) from error
    return content


def estimates_of(results: dict[str, Any], row: int) -> tuple[Estimate, ...]:
    """What the tracker said about one frame of `read_results`, one a slot."""
    found, camera = [], results["metadata"].get("camera") or {}
    size_px = (camera["width"], camera["height"]) if "width" in camera else None
    for slot in np.ndindex(results["lost"].shape[1:]):
        places = {name: (row, *slot) if name in HAND_FIELDS else row for name in KINDS}
        values = {name: results[name][place] for name, place in places.items()}
        values = {k: v if v.ndim else v.item() for k, v in values.items()}
        found.append(Estimate(**values, image_size_px=size_px))
    return tuple(found)


def _check_arrays(arrays: dict[str, np.ndarray]) -> None:
    """ValueError where arrays are not of as many frames and slots, or not of the types, that a
    track.npz has.
    """
    slots = arrays["lost"].shape
    if len(slots) not in (1, 2):
        raise ValueError(f"'lost' has the shape {slots}")
    for name, array in arrays.items():
        of_hand = slots if name in HAND_FIELDS else slots[:1]
        end = () if name == DROPPED else SHAPES.get(name, array.shape[len(of_hand) :])
        if array.shape != (*of_hand, *end):
            raise ValueError(f"{name!r} has the shape {array.shape}")
        known = np.dtype(KINDS.get(name, np.bool_)).kind
        if array.dtype.kind not in {"f": "fiu", "i": "iu"}.get(known, known):
            raise ValueError(f"{name!r} is {array.dtype}")


def read_run_facts(folder: Path) -> dict[str, Any]:
    """The content of a folder's run.json; ToftrackError when there is none that can be used."""
    path = folder / "run.json"
    with reported_errors(f"'{path}' cannot be read", "track again", OSError, ValueError):
        if not path.exists():
            raise ToftrackError(
                f"'{folder}' is not the output folder of a run: it has no run.json; give a folder "
                "that `toftrack track` wrote, such as outputs/DATE/TIME"
            )
        facts = read_json(path)
    remedy = "give another folder, or use the toftrack that wrote it"
    check_format(path, facts, RUN_FORMAT, _VERSION, "the description of a run", remedy)
    if not isinstance(facts.get("joint_names"), list) or not _are_metadata(facts.get("metadata")):
        raise ToftrackError(f"'{path}' does not describe a run; give another folder")
    return facts


def _are_metadata(metadata: Any) -> bool:
    """Whether what is told of a run is of the kinds that it should be."""
    if not isinstance(metadata, dict):
        return False
    parts = {name: metadata.get(name) or {} for name in _PARTS}
    whole = all(isinstance(part, dict) for part in parts.values())
    return whole and isinstance(parts["config"].get("device") or {}, dict)


_MANY = 0.05
"""Share of dropped frames that is worth a word."""
_MOST = 0.5


@dataclass
class RealTime:
    """How a run with a live device kept up, in numbers of frames and seconds."""

    fps: float
    """Frames a second that came."""
    tracked: int = 0
    reduced: int = 0
    """Of the tracked ones, with less than all effort."""
    dropped: int = 0
    """Frames that came too late."""
    busy_s: float = 0.0
    """The tracked ones took together, with all that was done with them."""
    longest_gap_s: float = 0.0
    """From one tracked frame to the next."""
    newest_s: float | None = None
    """Time stamp of the newest one; None before the first."""

    def add(self, timestamp_s: float, took_s: float, reduced: int, dropped: int) -> None:
        """One more frame.  reduced, dropped: of all frames until now."""
        gap_s = 0.0 if self.newest_s is None else timestamp_s - self.newest_s
        self.tracked += 1
        self.reduced, self.dropped = reduced, dropped
        self.busy_s += took_s
        self.longest_gap_s = max(self.longest_gap_s, gap_s)
        self.newest_s = timestamp_s

    @property
    def too_slow(self) -> bool:
        """Whether most frames were dropped, so that nothing else can be said of the run."""
        return self.dropped > _MOST * (self.tracked + self.dropped)

    def words(self) -> str:
        """What was dropped and what to do, one or two sentences; empty where it was little."""
        came = self.tracked + self.dropped
        if self.dropped <= _MANY * came:
            return ""
        took_ms = 1e3 * self.busy_s / max(1, self.tracked)
        quality = f", {self.reduced} of them with reduced effort" if self.reduced else ""
        dropped = f"{self.dropped} of {came} frames were dropped"
        took = f"tracking, drawing and sending a frame took {took_ms:.0f} ms"
        if took_ms * self.fps < 1e3:
            return (
                f"{dropped}, although {took} on average, which suffices for {self.fps:g} frames/s"
                f" ({self.tracked} were tracked{quality}): there were pauses of up to"
                f" {self.longest_gap_s:.1f} s, as at the start or beside other programs."
            )
        return (
            f"{dropped}: the machine was too slow for {self.fps:g} frames/s, as {took}"
            f" ({self.tracked} were tracked{quality}). Run nothing else meanwhile, draw less"
            " (view=none), or ask the camera for fewer frames or smaller images."
        )

    def summary(self) -> dict[str, Any]:
        """What summary.json says of it."""
        said = {
            "fps": round(self.fps, 3),
            "tracked_frames": self.tracked,
            "dropped_frames": self.dropped,
            "reduced_frames": self.reduced,
            "longest_gap_s": self.longest_gap_s,
        }
        return said | ({"note": self.words()} if self.words() else {})
