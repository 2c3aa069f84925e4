"""What a run left in its output folder, and the recording that it tracked."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.devices.synthetic import Synthetic
from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.json_text import read_json
from toftrack.frames.camera import Camera
from toftrack.frames.estimate import Estimate
from toftrack.frames.frame import Truth
from toftrack.frames.help_text import fields_in_help
from toftrack.hand.shape import HandShape
from toftrack.output.lines import DROPPED, HAND_FIELDS
from toftrack.output.results import estimates_of, read_results, read_run_facts
from toftrack.output.summary import shape_file
from toftrack.pose_space.base import PoseSpace
from toftrack.pose_space.files import make_pose_space
from toftrack.recordings.bare import Given
from toftrack.recordings.frame_store import FrameStore
from toftrack.recordings.npz import Recording
from toftrack.recordings.store import FIRST_SAMPLE, open_recording, open_sample
from toftrack.render.likelihood import FMeasure
from toftrack.render.segmentation import Expected, NearestSurface, Observation

FILES = ("track.npz", "track.jsonl", "summary.json", "hand_shape.json")
"""What a folder must hold to be a run's."""

_MOST_SYNTHETIC = 20_000
"""Frames of `device=synthetic` that are made again: 3 GB."""
_SAME_TIME_S = 0.002


@fields_in_help
@dataclass(frozen=True, eq=False)
class Run:
    """A finished run: T frames, a row for each; see `read_run`."""

    folder: Path
    """Where it is."""
    results: dict[str, Any] = field(repr=False)
    """Of `read_results`: the arrays of track.npz, `joint_names` and `metadata`."""
    frames: np.ndarray = field(repr=False)
    """(T,) int64 numbers of the input frames."""
    summary: dict[str, Any] = field(repr=False)
    """Of summary.json."""
    shapes: tuple[HandShape, ...] = field(repr=False)
    """The hands at the end of the run, one a slot."""

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """What was estimated, by name: the fields of Estimate, each with a row a frame, as
        `joints_m` (T, 21, 3), with `hands=N` (T, N, 21, 3), and those of the whole run, as
        `angle_names`. docs/formats.md lists them.
        """
        return {
            name: value for name, value in self.results.items() if isinstance(value, np.ndarray)
        }

    @property
    def timestamp_s(self) -> np.ndarray:
        """(T,) float64 seconds, the frames' times."""
        return self.results["timestamp_s"]

    @property
    def camera(self) -> Camera:
        """The camera of the run, whose undistorted image the joints belong to."""
        about = self.results["metadata"].get("camera") or {}
        known = {one.name for one in fields(Camera)}
        if not {"K", "width", "height"} <= about.keys():
            raise ToftrackError(f"the run in '{self.folder}' does not say which camera it had")
        return Camera(**{name: value for name, value in about.items() if name in known})

    def footage(self, recording: str | Path | None = None) -> Footage | None:
        """The images that were tracked, of the recording where it is now; None of a live camera.

        recording: where it is, if it was moved.  Raises ToftrackError when it is gone or changed.
        """
        opened = open_tracked(self.results["metadata"], self._ran_in, recording)
        if opened is None:
            return None
        store, name = opened
        device = self.config.get("device") or {}
        about = self.results["metadata"].get("device") or {}
        camera = store.camera
        if about.get("camera_file"):
            camera = Camera.load(found_again(about["camera_file"], self._ran_in))
        rows = _rows(self, store, camera, about, device, name)
        truth = store.truth
        return Footage(store, camera, rows, None if truth is None else truth.of_frames(rows))

    @property
    def config(self) -> dict[str, Any]:
        """The run's configuration."""
        return self.results["metadata"].get("config") or {}

    @property
    def shape(self) -> HandShape:
        """The hand at the end of the run, of several that of the first slot."""
        return self.shapes[0]

    def slot(self, number: int) -> Run:
        """The run as if only one of its slots had been followed."""
        if len(self.shapes) == 1:
            return self
        results = {
            name: array[:, number] if name in HAND_FIELDS else array
            for name, array in self.results.items()
        }
        return replace(self, results=results, shapes=self.shapes[number : number + 1])

    def estimates(self, row: int) -> tuple[Estimate, ...]:
        """What the tracker said about one frame, one a slot."""
        return estimates_of(self.results, row)

    def estimate(self, row: int) -> Estimate:
        """What the tracker said about one frame of a run with one slot, see `slot`."""
        return self.estimates(row)[0]

    def likelihood(self) -> FMeasure:
        """The run's likelihood; ToftrackError when it is none that this program knows."""
        return self._made(FMeasure, "likelihood")

    def segmentation(self) -> NearestSurface:
        """The run's segmentation; ToftrackError when it is none that this program knows."""
        return self._made(NearestSurface, "segmentation")

    def pose_space(self) -> PoseSpace:
        """The run's pose space, read or learned anew; ToftrackError when its file is gone."""
        settings = self._settings("pose_space", make_pose_space)
        if settings.get("file"):
            settings["file"] = str(found_again(settings["file"], self._ran_in))
        space = make_pose_space(**settings)
        if space.dims != self.results["latent"].shape[-1]:
            raise ToftrackError(
                f"'{settings.get('file')}' is no longer the {self.results['latent'].shape[-1]}-"
                "dimensional pose space of the run; put the old file back"
            )
        return space

    @property
    def _ran_in(self) -> str | None:
        """The working folder of the run; None: nobody knows."""
        folder = read_run_facts(self.folder).get("working_folder")
        return None if folder is None else str(folder)

    def _settings(self, group: str, known: Callable[..., Any]) -> dict[str, Any]:
        """A group's, which are for what is known here: no file says what is to be executed."""
        settings = self.config.get(group)
        if not isinstance(settings, dict):
            raise ToftrackError(
                f"'{self.folder / 'track.npz'}' does not say which {group} made it; run "
                "track.py again with this version"
            )
        settings = dict(settings)
        target, kind = settings.pop("_target_", None), str(settings.get("kind"))
        if target != f"{known.__module__}.{known.__qualname__}" or "." in kind:
            own = kind if "." in kind else target
            raise ToftrackError(
                f"the run in '{self.folder}' has a {group.replace('_', ' ')} of its own, {own}, "
                "which a run's files may not load; what needs none can be read all the same"
            )
        return settings

    def _made(self, kind: type, group: str) -> Any:
        settings = self._settings(group, kind)
        # JSON has no word for infinity: a number that is null was one.
        for one in fields(kind):
            if one.type == "float" and settings.get(one.name, 0.0) is None:
                settings[one.name] = math.inf
        with reported_errors(
            f"the {group} of the run in '{self.folder}' is of another version",
            "run track.py again with this one",
            TypeError,
        ):
            return kind(**settings)


@dataclass(frozen=True, eq=False, repr=False)  # of a recording it would fill the terminal
class Footage:
    """The images of a run's T frames, and their truth: `depth(row)` and `amplitude(row)`."""

    store: FrameStore
    camera: Camera
    rows: np.ndarray
    """(T,) positions in the store."""
    truth: Truth | None
    """Of T rows."""

    def depth(self, row: int) -> np.ndarray:
        """(H, W) float32 metres, rectified, 0 = no reading."""
        depth, _ = self.store.image(int(self.rows[row]))
        return self.camera.rectify(depth, self.store.radial)

    def amplitude(self, row: int) -> np.ndarray | None:
        """(H, W) uint16, undistorted; or None."""
        return self.camera.undistort_amplitude(self.store.image(int(self.rows[row]))[1])


def read_run(folder: str | Path) -> Run:
    """Read what a run left in its output folder.

        run = toftrack.read_run("outputs/2026-01-31/12-00-00-000000")
        run.arrays["joints_m"], run.timestamp_s, run.camera, run.summary["frames"]
        run.estimate(30)

    Raises ToftrackError when it is no run's, or something in it is missing or damaged.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise ToftrackError(
            f"there is no folder '{folder}'; give the output folder of toftrack track"
        )
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        read_run_facts(folder)  # which says where it is no run's at all
        made_anew = {"track.npz", "summary.json"}.issuperset(missing)
        remedy = f"try `toftrack recover {folder}`" if made_anew else "put it back, or track again"
        raise ToftrackError(
            f"'{folder}' lacks {' and '.join(missing)}, so the run did not finish or the file was "
            f"moved; {remedy}"
        )
    results = read_results(folder / "track.npz")
    if not len(results["lost"]):
        raise ToftrackError(f"the run in '{folder}' has no frame; there is nothing to read")
    slots = 1 if results["lost"].ndim == 1 else results["lost"].shape[1]
    what = f"'{folder / 'summary.json'}' cannot be read"
    with reported_errors(what, "run track.py again", OSError, ValueError):
        summary = read_json(folder / "summary.json")
        if not isinstance(summary, dict):
            raise ValueError("it is no JSON object")
    shapes = tuple(HandShape.load(folder / shape_file(slot)) for slot in range(slots))
    return Run(folder, results, results["index"], summary, shapes)


def found_again(path: str | Path, ran_in: str | None) -> Path:
    """A path of a run's configuration as it is now: relative to here, or to where the run was."""
    path = Path(path).expanduser()
    if path.exists() or path.is_absolute() or ran_in is None:
        return path
    return Path(ran_in) / path


def open_tracked(
    metadata: dict[str, Any], ran_in: str | None, recording: str | Path | None = None
) -> tuple[FrameStore, object] | None:
    """The recording that a run's device played, and its name; None when it was a live camera.

    ran_in: the run's working folder.  recording: where it is now, if it was moved.  Raises
    ToftrackError when it is gone, or cannot be read.
    """
    about = metadata.get("device") or {}
    device = (metadata.get("config") or {}).get("device") or {}
    name, kind = about.get("recording"), about.get("device")
    if recording is None and kind == "synthetic":
        return _synthetic(device), "the synthetic frames"
    if recording is None and kind == "sample":
        return open_sample(about.get("name", FIRST_SAMPLE)), name
    if recording is None and name is None:
        return None
    path = found_again(str(name), ran_in) if recording is None else Path(recording).expanduser()
    if not path.exists():
        raise ToftrackError(
            f"the recording '{path}' is not there{' any more' if recording is None else ''}; "
            "say where it is with --recording FILE"
        )
    given = {one.name: device[one.name] for one in fields(Given) if one.name in device}
    file = about.get("camera_file")
    given["camera_file"] = None if file is None else found_again(file, ran_in)
    return open_recording(path, Given(**given)), path


def _rows(
    run: Run, store: FrameStore, camera: Camera, about: dict, device: dict, name: object
) -> np.ndarray:
    """Which frame of the recording each row is; ToftrackError when it cannot be the same one."""
    advice = "give the recording of this run with --recording FILE, or run track.py again"
    start, stop = about.get("start", 0), about.get("stop", len(store))
    all_of_it = device.get("stop") is None
    if stop > len(store) or (all_of_it and stop != len(store)):
        raise ToftrackError(
            f"'{name}' is not what this run tracked, or has changed: it has {len(store)} frames "
            f"instead of {'' if all_of_it else 'at least '}{stop}; {advice}"
        )
    rows = run.frames
    if about.get("repeat"):
        rows = start + (rows - start) % max(1, stop - start)
    if rows.min() < 0 or rows.max() >= len(store):
        raise ToftrackError(
            f"the run tracked frames {rows.min()} to {rows.max()}, but '{name}' has only "
            f"{len(store)}; {advice}"
        )
    size = run.results["metadata"].get("camera") or {}
    if (camera.width, camera.height) != (size.get("width"), size.get("height")):
        raise ToftrackError(
            f"'{name}' has {camera.width}x{camera.height} pixels, but the run tracked "
            f"{size.get('width')}x{size.get('height')}; {advice}"
        )
    times, own = run.results["timestamp_s"], ~run.results[DROPPED]
    late = np.abs(np.asarray(store.timestamp_s)[rows] - times)[own].max()
    if not about.get("repeat") and late > _SAME_TIME_S:
        raise ToftrackError(
            f"'{name}' is not what this run tracked: its frames have other times; {advice}"
        )
    return rows


def _synthetic(device: dict[str, Any]) -> Recording:
    """The frames that `device=synthetic` made, made again."""
    if not (isinstance(device.get("frames"), int) and 1 <= device["frames"] <= _MOST_SYNTHETIC):
        raise ToftrackError(
            f"the run's synthetic frames cannot be made again: there must be 1 to "
            f"{_MOST_SYNTHETIC}, not {device.get('frames')}; keep them next time, with record=FILE"
        )
    made = Synthetic(**{key: value for key, value in device.items() if key != "_target_"})
    frames = list(made)
    return Recording(
        depth=np.stack([frame.depth for frame in frames]),
        radial=False,
        camera=made.camera,
        timestamp_s=np.array([frame.timestamp_s for frame in frames]),
        fps=made.fps,
        amplitude=np.stack([np.asarray(frame.amplitude) for frame in frames]),
        truth=made.truth,
    )


def observe(run: Run, footage: Footage, row: int) -> Observation:
    """One frame of a run with one slot segmented as the tracker did; where the hand was expected
    follows from the row before instead of the tracker's prediction.
    """
    expected = None
    if row > 0 and not run.results["lost"][row - 1]:
        depths = run.results["joints_m"][row - 1][:, 2]
        expected = Expected(float(depths.min()), float(depths.max()))
    return run.segmentation()(footage.depth(row), np.array(footage.camera.K), expected)
