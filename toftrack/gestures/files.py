"""A user's gestures: named poses of 21 joint angles, in a .json or .csv file.

.json:
    {"units": "degrees",
     "poses": [{"name": "vsign", "angles": {"index_mcp_flexion": 0, "index_pip_flexion": 0, ...}},
               {"name": "fist", "angles": [null, null, null, null, null, 0, 88, 100, 50, ...]}]}
    `angles` is an object with names of hand.skeleton.ANGLE_NAMES, or a list of all 21 in their
    order. `spread`, likewise and beside it, says by how much the angles vary (standard deviation)
    where somebody has seen; `toftrack gesture add` writes it.

.csv: a first line `# units: degrees` or `# units: radians`, a header with `name` and any of the 21
angle names, one pose a row.

An angle that is left out, null or empty does not matter. Poses of the same name are one gesture.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.json_text import read_json, write_json
from toftrack.gestures import features
from toftrack.hand.skeleton import ANGLE_LIMITS, ANGLE_NAMES, FINGERS
from toftrack.pose_space.data.pose_files import SLACK_DEGREES, in_radians, named_cells, read_table


class NamedPose(NamedTuple):
    """name: of the gesture.  angles_rad: (21,) float64, NaN where the angle does not matter.
    spread_rad: (21,) by how much each may vary more than usual, 0 where nobody says.
    """

    name: str
    angles_rad: np.ndarray
    spread_rad: np.ndarray = np.zeros(len(ANGLE_NAMES))


def read_poses(path: str | Path) -> list[NamedPose]:
    """The named poses of a .json or .csv file, clamped to the joint limits."""
    path = Path(path).expanduser()
    reader = {".json": _read_json, ".csv": _read_csv}.get(path.suffix.lower())
    if reader is None:
        raise ToftrackError(f"{path} is neither .json nor .csv; give gestures.file=FILE as one")
    what = f"{path} cannot be read as a file of gestures"
    with reported_errors(what, "give another gestures.file", OSError, ValueError, csv.Error):
        units, rows = reader(path)
    if not rows:
        raise ToftrackError(f"{path} names no pose")
    named = [(_name(path, n, row[0]), row[1], row[2]) for n, row in enumerate(rows, 1)]
    angles = np.array([_angles(path, name, given) for name, given, _ in named])
    spread = np.nan_to_num([_angles(path, name, varied) for name, _, varied in named])
    if (spread < 0).any():
        raise ToftrackError(f"{path} has a spread below 0; give standard deviations, 0 or more")
    radians = in_radians(path, angles, units, "say in it that they are {}")
    spread = np.radians(spread) if units == "degrees" else spread
    return [
        NamedPose(name, _within_limits(path, name, pose), varied)
        for (name, *_), pose, varied in zip(named, radians, spread, strict=True)
    ]


def save_poses(path: str | Path, poses: Sequence[NamedPose]) -> None:
    """Write named poses as .json, in degrees; what the file held before is gone."""
    path = Path(path).expanduser()
    content = {
        "units": "degrees",
        "poses": [
            {
                "name": pose.name,
                "angles": _in_degrees(pose.angles_rad),
                "spread": _in_degrees(pose.spread_rad),
            }
            for pose in poses
        ],
    }
    what = f"the file of gestures '{path}' cannot be written"
    with reported_errors(what, "choose another place with --file FILE"):
        write_json(path, content)


def _in_degrees(angles_rad: np.ndarray) -> dict[str, float]:
    """Angles by their names, without those that do not matter."""
    return {
        name: round(math.degrees(angle), 1)
        for name, angle in zip(ANGLE_NAMES, angles_rad, strict=True)
        if math.isfinite(angle)
    }


def _name(path: Path, number: int, name: object) -> str:
    if not isinstance(name, str) or not name.strip():
        raise ToftrackError(f"{path}: pose {number} has no name")
    return name.strip()


def _angles(path: Path, name: str, given: Mapping[str, Any]) -> list[float]:
    """The 21 angles as they stand there, NaN where there is none."""
    unknown = [key for key in given if key not in ANGLE_NAMES]
    if unknown:
        raise ToftrackError(
            f"{path}: pose {name!r} has the unknown angle {unknown[0]!r}; known are"
            f" {', '.join(ANGLE_NAMES)}"
        )
    angles = []
    for key in ANGLE_NAMES:
        value = given.get(key)
        if value is None or value == "":
            angles.append(math.nan)
            continue
        try:
            # float(True) is 1: not what anybody means by an angle.
            angle = math.nan if isinstance(value, bool) else float(value)
        except (TypeError, ValueError):
            angle = math.nan
        if not math.isfinite(angle):
            raise ToftrackError(f"{path}: {key} of pose {name!r} is {value!r}, not a finite number")
        angles.append(angle)
    return angles


def _within_limits(path: Path, name: str, radians: np.ndarray) -> np.ndarray:
    low, high = np.array(ANGLE_LIMITS).T
    outside = np.nan_to_num(np.maximum(low - radians, radians - high))
    worst = int(outside.argmax())
    if outside[worst] > math.radians(SLACK_DEGREES):
        raise ToftrackError(
            f"{path}: {ANGLE_NAMES[worst]} = {math.degrees(radians[worst]):.0f} degrees in pose"
            f" {name!r} is beyond a hand's joint limits ({math.degrees(low[worst]):.0f} .."
            f" {math.degrees(high[worst]):.0f} degrees; flexion is positive)"
        )
    return np.clip(radians, low, high)


_Row = tuple[object, Mapping[str, Any], Mapping[str, Any]]
"""A pose's name, its angles and its spread as they stand there, by the angles' names."""
_Content = tuple[str | None, list[_Row]]


def _read_json(path: Path) -> _Content:
    content = read_json(path)
    poses = content.get("poses") if isinstance(content, dict) else None
    if not isinstance(poses, list):
        raise ToftrackError(f"{path} has no list 'poses' of objects with 'name' and 'angles'")
    rows: list[_Row] = []
    for number, pose in enumerate(poses, 1):
        pose = pose if isinstance(pose, dict) else {}
        angles = _by_name(path, number, "angles", pose.get("angles"))
        spread = _by_name(path, number, "spread", pose.get("spread", {}))
        rows.append((pose.get("name"), angles, spread))
    units = content.get("units")
    return None if units is None else str(units).lower(), rows


def _by_name(path: Path, number: int, key: str, given: object) -> dict[str, Any]:
    """Angles as an object, also where they were given as a list of all."""
    if isinstance(given, list) and len(given) == len(ANGLE_NAMES):
        return dict(zip(ANGLE_NAMES, given, strict=True))
    if not isinstance(given, dict):
        raise ToftrackError(
            f"{path}: pose {number} must have '{key}', an object of angle names or a list of"
            f" {len(ANGLE_NAMES)}"
        )
    return given


def _read_csv(path: Path) -> _Content:
    units, table = read_table(path)
    if not table or "name" not in table[0]:
        raise ToftrackError(f"{path} has no column 'name'; the header must name it and the angles")
    return units, [(row.pop("name"), row, {}) for row in named_cells(path, table)]


_NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
_FEWEST_FRAMES = 5


def learned_pose(
    name: str, angles_rad: np.ndarray, believed: np.ndarray, steady_rad: float
) -> NamedPose:
    """The median of the joint angles over the believed frames, and how much they vary.

    Medians and median deviations, so that a few frames with a wrong finger do no harm.

    angles_rad: (T, 21) of the frames.  believed: (T,) bool, those whose estimate is to be used.
    steady_rad: the most that a finger's total flexion may vary, standard deviation.
    ToftrackError when fewer than half of the frames are believed, or the hand moves.
    """
    count, every = int(believed.sum()), len(believed)
    if count < max(_FEWEST_FRAMES, every / 2):
        raise ToftrackError(
            f"the hand was followed in only {count} of the {every} frames (at least half of them"
            f" and {_FEWEST_FRAMES} are needed); give a part of the recording in which track.py"
            " follows it, and say whose hand it is, hand.side=left or right"
        )
    seen = angles_rad[believed].astype(np.float64)
    flexion = _deviation(seen @ features.SUMS[features.FLEXION].T)
    worst = int(flexion.argmax())
    if flexion[worst] > steady_rad:
        raise ToftrackError(
            f"the hand holds no one pose there: the {FINGERS[1 + worst]} finger bends and"
            f" stretches by {math.degrees(flexion[worst]):.0f} degrees (standard deviation); give"
            " a part of the recording in which it is held still"
        )
    return NamedPose(name, np.median(seen, axis=0), _deviation(seen))


def _deviation(values: np.ndarray) -> np.ndarray:
    """Robust standard deviation of each column, (T, k) to (k,)."""
    return _NORMAL_MAD * np.median(np.abs(values - np.median(values, axis=0)), axis=0)
