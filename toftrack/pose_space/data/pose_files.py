"""A user's own poses: 21 joint angles a row, in a .csv or .npz file.

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

from toftrack.archives import read_archive
from toftrack.errors import ToftrackError
from toftrack.hand.skeleton import ANGLE_LIMITS, ANGLE_NAMES
from toftrack.pose_space.data.pose_data import PoseData
from toftrack.safe_files import open_to_read

UNITS = ("degrees", "radians")
_SLACK_DEGREES = 10.0


def file_data(path: str, units: str | None = None) -> PoseData:
    """Read a file of joint angles.

    path: ending in .csv or .npz.
    units: degrees or radians; None takes what the file says.

    Raises ToftrackError, naming the file and the place in it, when a column is missing, a value is
    not a number, the units are unknown or do not fit the values, or no pose is possible for a hand.
    """
    readers = {".csv": _read_csv, ".npz": _read_npz}
    reader = readers.get(Path(path).suffix.lower())
    if reader is None:
        raise ToftrackError(f"{path} is neither .csv nor .npz; give data.path=FILE of either kind")
    try:
        angles, labels, clips, said = reader(path)
    except FileNotFoundError:
        raise ToftrackError(f"no file of joint angles at {path}; give data.path=FILE") from None
    except OSError as error:
        why = error.strerror or error
        raise ToftrackError(f"{path} cannot be read ({why}); give data.path=FILE") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ToftrackError(
            f"{path} cannot be read as a table of joint angles ({error}); save it as"
            " comma-separated text in UTF-8"
        ) from None
    if len(angles) < 2:
        raise ToftrackError(f"{path} holds {len(angles)} poses; a pose space needs many more")
    bad = np.argwhere(~np.isfinite(angles))
    if len(bad):
        row, column = bad[0]
        raise ToftrackError(
            f"{path}: {ANGLE_NAMES[column]} of pose {row + 1} is not a finite number"
            f" ({angles[row, column]})"
        )
    radians = _in_radians(path, angles, units or said)
    radians, note = within_limits(path, radians)
    names = list(dict.fromkeys(clips))
    source = {"data": "file", "file": Path(path).name, "poses": len(radians)}
    return PoseData(
        torch.from_numpy(radians),
        tuple(labels),
        torch.tensor([names.index(clip) for clip in clips]),
        (source,),
        (f"{Path(path).name}: {len(radians)} poses in {len(names)} clips{note}",),
    )


def _in_radians(path: str, angles: np.ndarray, units: str | None) -> np.ndarray:
    if units not in UNITS:
        what = "does not say its units" if units is None else f"has the unknown units {units!r}"
        raise ToftrackError(f"{path} {what}; give data.units=degrees or data.units=radians")
    largest = float(np.abs(angles).max())
    # No joint bends by more than 2.1 rad, and no collection of hands stays within 2.1 degrees.
    if units == "radians" and largest > 4.0:
        raise ToftrackError(
            f"{path} has angles up to {largest:.1f} and is said to be in radians, which no joint"
            " reaches; if they are degrees give data.units=degrees"
        )
    if units == "degrees" and largest < 3.0:
        raise ToftrackError(
            f"{path} has no angle above {largest:.2f} and is said to be in degrees, so that the"
            " hand would hardly move; if they are radians give data.units=radians"
        )
    return np.radians(angles) if units == "degrees" else angles


def within_limits(path: str, radians: np.ndarray) -> tuple[np.ndarray, str]:
    """Angles (M, 21) clamped to the joint limits, and how many were, as the end of a sentence.

    path: what errors call them.  Raises ToftrackError where most poses are far outside.
    """
    low, high = np.array(ANGLE_LIMITS).T
    outside = np.maximum(low - radians, radians - high)
    far = (outside > math.radians(_SLACK_DEGREES)).any(1)
    if far.mean() > 0.5:
        row, column = np.unravel_index(outside.argmax(), outside.shape)
        raise ToftrackError(
            f"{path}: {int(far.sum())} of {len(far)} poses are beyond a hand's joint limits by more"
            f" than {_SLACK_DEGREES:.0f} degrees, as {ANGLE_NAMES[column]} ="
            f" {math.degrees(radians[row, column]):.0f} degrees in pose {row + 1}; are the columns"
            " and their signs those of this hand (flexion positive)?"
        )
    moved = int((outside > 1e-9).any(1).sum())
    note = f", {moved} of them clamped to the joint limits" if moved else ""
    return np.clip(radians, low, high), note


_Content = tuple[np.ndarray, list[str], list[str], str | None]


def _read_csv(path: str) -> _Content:
    said = None
    with TextIOWrapper(open_to_read(path), "utf-8-sig", newline="") as stream:
        lines = []
        for line in stream:
            if line.lstrip().startswith("#"):
                key, _, value = line.lstrip("# \t").partition(":")
                said = value.strip().lower() if key.strip().lower() == "units" else said
            elif line.strip():
                lines.append(line)
    rows = list(csv.reader(lines, skipinitialspace=True))
    header = [name.strip() for name in rows[0]] if rows else []
    if not header:
        raise ToftrackError(
            f"{path} is empty; it must have a header of the {len(ANGLE_NAMES)} joint angles' names"
            " and a pose a row"
        )
    twice = [name for name in (*ANGLE_NAMES, "label", "clip") if header.count(name) > 1]
    if twice:
        raise ToftrackError(f"{path} has {header.count(twice[0])} columns {twice[0]!r}; keep one")
    missing = [name for name in ANGLE_NAMES if name not in header]
    if len(missing) == len(ANGLE_NAMES):
        raise ToftrackError(
            f"{path} has no header of comma-separated names of joint angles, as"
            f" {missing[0]},{missing[1]},...; its first line is {lines[0].strip()[:40]!r}"
        )
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ToftrackError(
            f"{path} has no column {missing[0]!r}{more}; the header must name all"
            f" {len(ANGLE_NAMES)} joint angles"
        )
    columns = [header.index(name) for name in ANGLE_NAMES]
    angles = np.empty((len(rows) - 1, len(ANGLE_NAMES)))
    for number, row in enumerate(rows[1:], 1):
        if len(row) != len(header):
            raise ToftrackError(
                f"{path}: pose {number} has {len(row)} values for {len(header)} columns"
            )
        for place, column in enumerate(columns):
            try:
                angles[number - 1, place] = float(row[column])
            except ValueError:
                raise ToftrackError(
                    f"{path}: {ANGLE_NAMES[place]} of pose {number} is {row[column]!r}, not a"
                    " number"
                ) from None

    def texts(name: str, default: str) -> list[str]:
        if name not in header:
            return [default] * (len(rows) - 1)
        return [row[header.index(name)].strip() for row in rows[1:]]

    labels = texts("label", Path(path).stem)
    return angles, labels, texts("clip", "") if "clip" in header else labels, said


def _read_npz(path: str) -> _Content:
    try:
        content = read_archive(path)
    except ValueError as error:
        raise ToftrackError(f"{path} is not an .npz of joint angles ({error})") from None
    if {"state", "lost"} <= content.keys():
        raise ToftrackError(f"{path} is of a run; give data=run data.path={path}")
    if "angles" not in content:
        raise ToftrackError(f"{path} has no array 'angles' of (poses, {len(ANGLE_NAMES)})")
    angles = content["angles"]
    if angles.ndim != 2 or angles.shape[1] != len(ANGLE_NAMES) or angles.dtype.kind not in "fiu":
        raise ToftrackError(
            f"{path}: 'angles' is {angles.dtype} of the shape {angles.shape}; it must be numbers of"
            f" (poses, {len(ANGLE_NAMES)})"
        )
    names = [str(name) for name in content.get("angle_names", ANGLE_NAMES)]
    missing = [name for name in ANGLE_NAMES if name not in names]
    if missing or len(names) != len(ANGLE_NAMES):
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
