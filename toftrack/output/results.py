"""The result files of a run: track.npz, track.jsonl and summary.json.

`track.jsonl` grows by a line as each frame is done. `track.npz` and `summary.json` are written when
the writer is closed, also after an interruption, for the frames that were done until then.
"""

from __future__ import annotations

import json
import math
import os
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.estimate import Estimate
from toftrack.frames import Truth
from toftrack.output.coverage import coverage
from toftrack.output.evaluation import evaluate
from toftrack.output.trust import Hand, trust

_ARRAYS: dict[str, type] = {
    "joints_m": np.float32,
    "lost": np.bool_,
    "state": np.float32,
    "latent": np.float32,
    "score": np.float32,
    "covariance": np.float32,
    "effective_sample_size": np.float32,
    "gesture": np.str_,
    "gesture_probability": np.float32,
    "timestamp_s": np.float64,
    "compute_s": np.float32,
}
_LATER: dict[str, type] = {
    "pinch": np.float32,
    "pinching": np.bool_,
    "pointing_origin_m": np.float32,
    "pointing_direction": np.float32,
    "joint_sigma_m": np.float32,
    "joint_confidence": np.float32,
    "index": np.int64,
    "state_name": np.str_,
    "confidence": np.float32,
    "outside_rad": np.float32,
    "side": np.str_,
    "side_probability": np.float32,
}
"""Arrays that came later: older files without them are results as well."""
LINE_FIELDS = (
    "index",
    "timestamp_s",
    "state_name",
    "lost",
    "confidence",
    "outside_rad",
    "side",
    "side_probability",
    "score",
    "joints_m",
    "state",
    "latent",
    "covariance",
    "joint_sigma_m",
    "joint_confidence",
    "effective_sample_size",
    "gesture",
    "gesture_probability",
    "pinch",
    "pinching",
    "pointing_origin_m",
    "pointing_direction",
    "compute_s",
)
"""What a line of track.jsonl says, fields of Estimate, in their order."""


class ResultWriter:
    """Writes a run's result files into a folder; use it with `with`.

    Frames that a device dropped leave gaps between the indices of the estimates. `track.npz` has a
    row for every frame of the input nevertheless: a dropped frame repeats the newest estimate there
    was, with no time spent on it, and is listed in the metadata as `held_frames`.

    Args:
        folder: made when it does not exist.
        metadata: facts about the run, JSON-able, for `track.npz`.
        joint_names: the 21 names, in the order of the joints.
        truth: ground truth from the first appended frame on; adds `metrics` to the summary.

    Raises:
        ToftrackError: the folder cannot be made or written, or a file in it cannot.
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
        self._metadata = metadata
        self._joint_names = tuple(joint_names)
        self._truth = truth
        self._estimates: list[Estimate] = []
        self._closed = False
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lines = open(self.folder / "track.jsonl", "w", encoding="utf-8")
        except OSError as error:
            raise _unwritable(self.folder, error) from error

    def append(self, estimate: Estimate) -> None:
        """Add a frame's estimate and write its line to disk. Raises ToftrackError if it cannot."""
        try:
            self._lines.write(json_line(estimate) + "\n")
            self._lines.flush()
        except OSError as error:
            raise _unwritable(self.folder, error) from error
        self._estimates.append(estimate)

    def close(self) -> None:
        """Write track.npz and summary.json; a second call does nothing.

        Raises ToftrackError when they cannot be written.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._lines.close()
            arrays, held = self._arrays()
            metadata = self._metadata | ({"held_frames": held} if held else {})
            arrays["joint_names"] = np.array(self._joint_names, np.str_)
            arrays["metadata"] = np.array(json.dumps(_strict(metadata)))
            self.summary = self._summarise(arrays)
            _write_atomically(
                self.folder / "track.npz", lambda stream: np.savez_compressed(stream, **arrays)
            )
            text = json.dumps(_strict(self.summary), indent=1, allow_nan=False) + "\n"
            _write_atomically(
                self.folder / "summary.json", lambda stream: stream.write(text.encode())
            )
        except OSError as error:
            raise _unwritable(self.folder, error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _arrays(self) -> tuple[dict[str, Any], list[int]]:
        """The arrays of track.npz, and the indices of the frames that were dropped."""
        done = self._estimates
        if not done:
            return _no_frames(), []
        arrays: dict[str, Any] = {
            name: np.array([getattr(estimate, name) for estimate in done], dtype=kind)
            for name, kind in (_ARRAYS | _LATER).items()
        }
        index = arrays["index"]
        if (np.diff(index) < 1).any():  # the device counts anew; there is nothing to fill in
            return arrays, []
        every = np.arange(index[0], index[-1] + 1)
        rows = np.searchsorted(index, every, side="right") - 1
        held = index[rows] != every
        times = np.interp(every, index, arrays["timestamp_s"])
        arrays = {name: values[rows] for name, values in arrays.items()}
        arrays["index"], arrays["timestamp_s"] = every, times
        arrays["compute_s"][held] = 0
        return arrays, every[held].tolist()

    def _summarise(self, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
        done = self._estimates
        seconds = np.array([estimate.compute_s for estimate in done])
        scores = np.array([estimate.score for estimate in done])
        total = float(seconds.sum())
        summary: dict[str, Any] = {
            "frames": len(arrays["lost"]),
            "lost_frames": int(arrays["lost"].sum()),
            "mean_ms": 1e3 * float(seconds.mean()) if done else None,
            "median_ms": 1e3 * float(np.median(seconds)) if done else None,
            "fps": len(done) / total if total > 0 else None,
            "mean_score": float(scores.mean()) if done else None,
        }
        if self._truth is not None and done:
            truth = self._truth[: len(arrays["lost"])]
            joints, lost = arrays["joints_m"], arrays["lost"]
            figures = trust(joints, lost, Hand(truth.joints_m, truth.visible))
            summary["metrics"] = {"trust": asdict(figures)} | evaluate(joints, lost, truth)
            regions = coverage(joints, arrays["joint_sigma_m"], truth)
            summary["metrics"]["coverage"] = asdict(regions)
        return summary


def json_line(estimate: Estimate, fields: Sequence[str] = LINE_FIELDS) -> str:
    """An estimate as one line of strict JSON, without newline; NaN becomes null.

    fields: which of LINE_FIELDS, in this order.
    """
    content = {name: _strict(getattr(estimate, name)) for name in fields}
    return json.dumps(content, allow_nan=False, separators=(",", ":"))


def read_results(path: str | Path) -> dict[str, Any]:
    """The content of a track.npz: its arrays, `joint_names` as a tuple and `metadata` as a dict.

    A file of an older version lacks what came later (index, state_name, confidence, outside_rad,
    side, side_probability, the joints' regions and confidence, the pointing ray, the pinch).

    Raises ToftrackError when the file is missing, damaged or not a result.
    """
    path = Path(path).expanduser()
    names = (*_ARRAYS, "joint_names", "metadata")
    try:
        with np.load(path, allow_pickle=False) as archive:
            names += tuple(name for name in _LATER if name in archive)
            content: dict[str, Any] = {name: archive[name] for name in names}
        content["joint_names"] = tuple(content["joint_names"].tolist())
        content["metadata"] = json.loads(content["metadata"].item())
    except OSError as error:
        raise ToftrackError(
            f"the result file '{path}' cannot be read ({error.strerror or error}); give the path "
            "of a track.npz"
        ) from error
    except KeyError as error:
        raise ToftrackError(
            f"'{path}' is not a track.npz of this toftrack: {error.args[0]}; give the path of one"
        ) from None
    except (ValueError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        raise ToftrackError(
            f"'{path}' is not a track.npz, or it is damaged; give the path of one"
        ) from error
    return content


def _no_frames() -> dict[str, np.ndarray]:
    shapes = {"joints_m": (0, 21, 3), "state": (0, 27), "latent": (0, 4), "covariance": (0, 10, 10)}
    shapes |= {"joint_sigma_m": (0, 21, 3), "joint_confidence": (0, 21)}
    shapes |= dict.fromkeys(("pointing_origin_m", "pointing_direction"), (0, 3))
    kinds = _ARRAYS | _LATER
    return {name: np.zeros(shapes.get(name, 0), kind) for name, kind in kinds.items()}


def _strict(value: Any) -> Any:
    """`value` without what JSON cannot say: arrays become lists, NaN and infinity None."""
    if isinstance(value, dict):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _strict(value.tolist())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let `write` fill a binary stream; `path` changes only when all of it is on the disk."""
    partial = path.with_name(path.name + ".part")
    try:
        with open(partial, "wb") as stream:
            write(stream)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _unwritable(folder: Path, error: OSError) -> ToftrackError:
    return ToftrackError(
        f"the output folder '{folder}' cannot be written ({error.strerror or error}); choose "
        "another with hydra.run.dir=DIR"
    )
