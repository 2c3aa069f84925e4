"""Files of joint angles: a user's own poses, 21 angles a row, and the poses of a finished run.

.csv: a first line `# units: degrees` or `# units: radians` (or data.units on the command line), a
header with the names of hand.skeleton.ANGLE_NAMES in any order, one pose a row. Two more columns
may stand beside them: `label` (a name) and `clip` (poses recorded together; held out together).
Other columns are left alone.

.npz: `angles` (M, 21) and `units` (or data.units); optional `angle_names`, where the order differs,
`labels` and `clips`.
"""

from __future__ import annotations

import csv
import math
from io import TextIOWrapper
from pathlib import Path

import numpy as np
import torch

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.archives import read_archive
from toftrack.files.safe_files import open_to_read
from toftrack.hand.skeleton import ANGLE_LIMITS, ANGLE_NAMES
from toftrack.pose_space.data.pose_data import CLIP, PoseData, spread_out

SLACK_DEGREES = 10.0
"""An angle may be so far beyond its joint's limit, and is clamped."""
_TRACK = "track.npz"
_RUN = "give data.path=RUN, the output folder of a run"


def read_table(path: str | Path) -> tuple[str | None, list[list[str]]]:
    """The units that a .csv says, and its rows of cells, the header first; OSError, UnicodeError or
    csv.Error.
    """
    units, lines = None, []
    with TextIOWrapper(open_to_read(path), "utf-8-sig", newline="") as stream:
        for line in stream:
            if line.lstrip().startswith("#"):
                key, _, value = line.lstrip("# \t").partition(":")
                units = value.strip().lower() if key.strip().lower() == "units" else units
            elif line.strip():
                lines.append(line)
    rows = csv.reader(lines, skipinitialspace=True)
    return units, [[cell.strip() for cell in row] for row in rows]


def named_cells(path: str | Path, table: list[list[str]]) -> list[dict[str, str]]:
    """The rows of a table by the names in its header."""
    header, *rows = table
    for number, row in enumerate(rows, 1):
        if len(row) != len(header):
            raise ToftrackError(
                f"{path}: pose {number} has {len(row)} values for {len(header)} columns"
            )
    return [dict(zip(header, row, strict=True)) for row in rows]


def in_radians(path: str | Path, angles: np.ndarray, units: str | None, say: str) -> np.ndarray:
    """Angles in radians, NaN where one is; ToftrackError where the units do not fit the values.

    say: what to do, as "give data.units=degrees", with {} for the units.
    """
    if units not in ("degrees", "radians"):
        what = "does not say its units" if units is None else f"has the unknown units {units!r}"
        raise ToftrackError(f"{path} {what}; {say.format('degrees or radians')}")
    largest = float(np.nan_to_num(np.abs(angles)).max())
    # No joint bends by more than 2.1 rad, and no collection of hands stays within 2.1 degrees.
    if units == "radians":
        wrong, size, other = largest > 4.0, "large", "degrees"
    else:
        wrong, size, other = 0 < largest < 3.0, "small", "radians"
    if wrong:
        raise ToftrackError(
            f"{path} has angles up to {largest:.3g}, too {size} for {units}; if they are {other}, "
            f"{say.format(other)}"
        )
    return np.radians(angles) if units == "degrees" else angles


def file_data(path: str, units: str | None = None) -> PoseData:
    """The poses of a .csv or .npz of joint angles.

    units: degrees or radians; None takes what the file says.
    """
    reader = {".csv": _read_csv, ".npz": _read_npz}.get(Path(path).suffix.lower())
    if reader is None:
        raise ToftrackError(f"{path} is neither .csv nor .npz; give data.path=FILE of either kind")
    remedy = "give data.path=FILE, a table of joint angles: an .npz, or comma-separated UTF-8 text"
    with reported_errors(f"{path} cannot be read", remedy, OSError, ValueError, csv.Error):
        angles, labels, clips, said = reader(path)
    if len(angles) < 2:
        raise ToftrackError(f"{path} holds {len(angles)} poses; a pose space needs many more")
    bad = np.argwhere(~np.isfinite(angles))
    if len(bad):
        row, column = bad[0]
        raise ToftrackError(
            f"{path}: {ANGLE_NAMES[column]} of pose {row + 1} is not a finite number"
            f" ({angles[row, column]})"
        )
    radians, note = _within_limits(
        path, in_radians(path, angles, units or said, "give data.units={}")
    )
    names = list(dict.fromkeys(clips))
    source = {"data": "file", "file": Path(path).name, "poses": len(radians)}
    return PoseData(
        torch.from_numpy(radians),
        tuple(labels),
        torch.tensor([names.index(clip) for clip in clips]),
        (source,),
        (f"{Path(path).name}: {len(radians)} poses in {len(names)} clips{note}",),
    )


def _within_limits(path: str | Path, radians: np.ndarray) -> tuple[np.ndarray, str]:
    """Angles (M, 21) clamped to the joint limits, and how many were, as the end of a sentence."""
    low, high = np.array(ANGLE_LIMITS).T
    outside = np.maximum(low - radians, radians - high)
    far = (outside > math.radians(SLACK_DEGREES)).any(1)
    if far.mean() > 0.5:
        row, column = np.unravel_index(outside.argmax(), outside.shape)
        raise ToftrackError(
            f"{path}: {int(far.sum())} of {len(far)} poses are beyond a hand's joint limits by more"
            f" than {SLACK_DEGREES:.0f} degrees, as {ANGLE_NAMES[column]} ="
            f" {math.degrees(radians[row, column]):.0f} degrees in pose {row + 1}; are the columns"
            " and their signs those of this hand (flexion positive)?"
        )
    moved = int((outside > 1e-9).any(1).sum())
    note = f", {moved} of them clamped to the joint limits" if moved else ""
    return np.clip(radians, low, high), note


_Content = tuple[np.ndarray, list[str], list[str], str | None]
"""Angles (M, 21) as they stand there, labels, clips, and units."""


def _read_csv(path: str) -> _Content:
    units, table = read_table(path)
    header = table[0] if table else []
    twice = [name for name in (*ANGLE_NAMES, "label", "clip") if header.count(name) > 1]
    if twice:
        raise ToftrackError(f"{path} has {header.count(twice[0])} columns {twice[0]!r}; keep one")
    missing = [name for name in ANGLE_NAMES if name not in header]
    if missing and f"{missing[0]}_rad" in header:
        raise ToftrackError(f"{path} was exported from a run; give data=run data.path=RUN")
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ToftrackError(
            f"{path} has no column {missing[0]!r}{more}; its first line must name all"
            f" {len(ANGLE_NAMES)} joint angles, comma-separated"
        )
    rows = named_cells(path, table)
    angles = np.empty((len(rows), len(ANGLE_NAMES)))
    for number, row in enumerate(rows):
        for column, name in enumerate(ANGLE_NAMES):
            try:
                angles[number, column] = float(row[name])
            except ValueError:
                raise ToftrackError(
                    f"{path}: {name} of pose {number + 1} is {row[name]!r}, not a number"
                ) from None
    labels = [row.get("label", Path(path).stem) for row in rows]
    return angles, labels, [row.get("clip", row.get("label", "")) for row in rows], units


def _read_npz(path: str) -> _Content:
    content = read_archive(path)
    if {"state", "lost"} <= content.keys():
        raise ToftrackError(f"{path} was written by a run; give data=run data.path={path}")
    if "angles" not in content:
        raise ToftrackError(f"{path} has no array 'angles' of (poses, {len(ANGLE_NAMES)})")
    angles = content["angles"]
    if angles.ndim != 2 or angles.shape[1] != len(ANGLE_NAMES) or angles.dtype.kind not in "fiu":
        raise ToftrackError(
            f"{path}: 'angles' is {angles.dtype} of the shape {angles.shape}; it must be numbers of"
            f" (poses, {len(ANGLE_NAMES)})"
        )
    names = [str(name) for name in np.ravel(content.get("angle_names", ANGLE_NAMES))]
    if sorted(names) != sorted(ANGLE_NAMES):
        missing = [name for name in ANGLE_NAMES if name not in names]
        raise ToftrackError(f"{path}: 'angle_names' does not name {missing or 'each angle once'}")
    angles = angles[:, [names.index(name) for name in ANGLE_NAMES]].astype(np.float64)

    def texts(name: str, default: list[str]) -> list[str]:
        if name not in content:
            return default
        values = [str(value) for value in content[name].ravel()]
        if len(values) != len(angles):
            raise ToftrackError(f"{path}: {len(values)} '{name}' for {len(angles)} poses")
        return values

    labels = texts("labels", [Path(path).stem] * len(angles))
    said = str(content["units"]).lower() if "units" in content else None
    return angles, labels, texts("clips", labels), said


def run_data(path: str, poses: int | None, confidence: float) -> PoseData:
    """Joint angles of the frames of a run that can be used; of several hands those of all.

    Poses that follow each other are a clip, as neighbours in time resemble each other.

    path: the run's output folder, or the track.npz in it.
    poses: at most so many, picked to cover what was shown; None keeps all.
    confidence: frames of which the tracker was less sure, 0..1, are left out.
    """
    place = Path(path).expanduser()
    place = place / _TRACK if place.is_dir() else place
    states, sure, usable = _read_run(place)
    kept = usable & (sure >= confidence) & np.isfinite(states).all(-1)
    angles = states[kept][:, 6:].astype(np.float64)
    if len(angles) < 2:
        raise ToftrackError(
            f"of the {len(kept)} frames of the run {place}, {len(angles)} are not lost and at"
            f" least {confidence:g} sure; give a longer recording, or a smaller"
            " data.confidence"
        )
    radians, note = _within_limits(place, angles)
    covering = spread_out(torch.from_numpy(radians), poses or len(radians)).numpy()
    clips = np.arange(len(radians))[covering] // CLIP
    name = place.parent.name if place.name == _TRACK else place.stem
    source = {"data": "run", "file": name, "poses": len(covering)}
    return PoseData(
        torch.from_numpy(radians[covering]),
        (name or "run",) * len(covering),
        torch.from_numpy(clips),
        (source,),
        (f"{place}: {len(covering)} of {len(kept)} poses{note}",),
    )


def _read_run(place: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (N, 27), confidences (N,) and which can be used (N,), the slots one after another."""
    with reported_errors(
        f"{place} cannot be read as the track.npz of a run", _RUN, OSError, ValueError
    ):
        content = read_archive(place, {"state", "lost", "confidence", "dropped"})
        size = 6 + len(ANGLE_NAMES)
        state, lost = (content.get(name, np.zeros(0)) for name in ("state", "lost"))
        states = state.dtype.kind == "f" and state.ndim in (2, 3)
        if not states or lost.dtype != bool or state.shape != (*lost.shape, size):
            raise ValueError(f"it has no states of {size} numbers")
        sure = content.get("confidence", np.ones(lost.shape))
        # A dropped frame repeats the one before.
        dropped = content.get("dropped", np.zeros(len(lost), bool))
        if sure.shape != lost.shape or dropped.shape != lost.shape[:1]:
            raise ValueError("damaged: its arrays are of different lengths")
    usable = ~lost & ~dropped.astype(bool).reshape(-1, *[1] * (lost.ndim - 1))
    # The frames of a hand one after another: (T, slots, 27) to (slots * T, 27).
    hands = state.reshape(len(state), -1, size).swapaxes(0, 1)
    flat = [array.reshape(len(state), -1).T.ravel() for array in (sure, usable)]
    return hands.reshape(-1, size), flat[0], flat[1]
