"""Single images of a recording that were labelled by eye, and what is measured with them.

Labels are a JSON file of one of two kinds. **Points**: the pixels of joints in some frames of a
recording, which is tracked as a whole:

    {"image_size": [512, 424], "side": "left", "frames": {"6": {"points":
        {"thumb_tip": [249.5, 170.8, "visible"], "wrist": [308, 182, "guessed"], ...}}, ...}}

`toftrack label` makes such a file; what else stands in it is not measured. A joint is compared
laterally: pixels between its projection and the label, times its own depth over the focal length.
Of visible fingertips, which are moved 5 mm towards the joint before them, as the labels are:
`tips_20_pct`, `tips_40_pct` are the frames in which all are within 20 and 40 mm; `wrong_pct` those
in which one is farther than 40 mm off, unflagged; `flagged_pct` those flagged lost;
`wrong_no_flag_pct` those not flagged lost in which a tip is so far off that `joint_ok` does not
flag; `tips_median_mm`, `tips_mean_mm` over all tips (a prediction that is not finite or not in
front of the camera is infinitely far off, and left out of the mean); `FLAG_COUNTS` of measures.py.

**Stills**: images that have nothing to do with one another, each with what it shows. Every one has
a fresh start and is shown so many frames, the last of which counts:

    {"image_size": [320, 240], "side": "right", "shown_frames": 10, "images": [1, 1, 2, ...],
     "called": {"1": ["palm"], "6": ["other", ""], ...}}

`images` says which of `called` each image shows, and `called` what that may be called.
`found_pct` are the images that are not lost, `named_pct` those of them that are called rightly,
`wrong_name_pct` those that are called something else, but for nothing and `other`.

Each labelled image counts as a recording of its own in totals, intervals and differences.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.evaluation.measures import FLAG_COUNTS, flag_counts
from toftrack.evaluation.statistics import figure, mean_of
from toftrack.evaluation.trust import OK_MM, TIPS, tips_inset
from toftrack.files.json_text import read_json
from toftrack.hand.skeleton import JOINT_NAMES

UNNAMED = ("", "other")
_INSET_M = 0.005
_MOST_SHOWN = 1000
"""Frames of a still; more than any start takes."""
_FLAGS = ("visible", "guessed", "absent")


@dataclass(frozen=True, eq=False)
class Points:
    """Labels of points.  frames: by its number, (u, v) of each of the 21 joints that is visible.
    content: as it stands in the file."""

    path: Path
    size: tuple[int, int]
    side: str
    frames: dict[int, dict[int, tuple[float, float]]]
    content: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Stills:
    """Labels of stills.  images: what each shows.  called: what that may be called."""

    path: Path
    size: tuple[int, int]
    side: str
    shown_frames: int
    images: tuple[str, ...]
    called: dict[str, tuple[str, ...]]


def read_labels(path: str | Path, begun: bool = False) -> Points | Stills:
    """Labels of either kind; where they are only `begun`, of points none need be visible yet.
    Raises ToftrackError, one sentence that names the file."""
    path = Path(path).expanduser()
    remedy = "give another --output" if begun else "give a file of JSON"
    with reported_errors(f"the labels '{path}' cannot be read", remedy, OSError, ValueError):
        content = read_json(path)
    what = f"the labels '{path}' are neither of points nor of stills"
    damaged = KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError
    remedy = "give a file of toftrack label in which a point was clicked (or see docs/accuracy.md)"
    with reported_errors(what, remedy, *damaged):
        return _parsed(path, content, begun)


def _parsed(path: Path, content: Any, begun: bool) -> Points | Stills:
    width, height = map(int, content["image_size"])
    size, side = (width, height), content["side"]
    if side not in ("right", "left"):
        raise ValueError(f"the side is {side!r}")
    if "frames" in content:
        given = content["frames"].items()
        frames = {int(key): _visible(frame["points"], size) for key, frame in given}
        if not (any(frames.values()) or begun) or min(frames, default=0) < 0:
            raise ValueError("no frame has a visible point")
        if list(content["frames"]) != [str(number) for number in frames]:
            raise ValueError("a frame's number is written in another way")
        return Points(path, size, side, frames, content)
    called = {str(key): tuple(map(str, names)) for key, names in content["called"].items()}
    images = tuple(str(image) for image in content["images"])
    shown = int(content["shown_frames"])
    for image in images:
        if image not in called:
            raise ValueError(f"'called' lacks {image}")
    if not images or not 1 <= shown <= _MOST_SHOWN:
        raise ValueError(f"there is no image to show, or more than {_MOST_SHOWN} times")
    return Stills(path, size, side, shown, images, called)


def _visible(points: Any, size: tuple[int, int]) -> dict[int, tuple[float, float]]:
    found = {}
    for name, (u, v, flag) in points.items():
        if flag not in _FLAGS:
            raise ValueError(f"the flag {flag!r} is unknown")
        if name not in JOINT_NAMES:
            raise ValueError(f"there is no joint {name!r}")
        if flag != "absent" and not math.isfinite(u + v):
            raise ValueError(f"the pixel {u}, {v} is none")
        if flag == "visible":
            if not (-1 <= u <= size[0] and -1 <= v <= size[1]):
                raise ValueError(f"the pixel {u}, {v} of a visible {name} is not in the image")
            found[JOINT_NAMES.index(name)] = float(u), float(v)
    return found


def point_rows(
    points: Points,
    joints_m: np.ndarray,
    lost: np.ndarray,
    joint_ok: np.ndarray,
    K: np.ndarray,
) -> dict[int, dict[str, Any]]:
    """The figures of each labelled frame that has a visible fingertip, by its number.

    joints_m: (T, 21, 3) metres, camera frame.  lost: (T,) bool.  joint_ok: (T, 21) bool.
    K: (3, 3), of undistorted pixels.
    Raises ToftrackError when a frame is labelled that the track has not.
    """
    if max(points.frames) >= len(joints_m):
        raise ToftrackError(
            f"the labels '{points.path}' are of frame {max(points.frames)}, but the recording has "
            f"{len(joints_m)} frames; give the recording that was labelled"
        )
    moved, found = tips_inset(joints_m, _INSET_M), {}
    for number, places in points.frames.items():
        tips = [row for row in places if row in TIPS]
        if not tips:
            continue
        errors = np.array([_lateral_mm(moved[number, row], places[row], K) for row in tips])
        flagged, ok, worst = bool(lost[number]), joint_ok[number][tips], errors.max()
        found[number] = {
            "tips_20_pct": _pct(worst < 20),
            "tips_40_pct": _pct(worst < 40),
            "wrong_pct": _pct(worst > 40 and not flagged),
            "flagged_pct": _pct(flagged),
            "wrong_no_flag_pct": _pct(not flagged and (ok & (errors > OK_MM)).any()),
            **(dict.fromkeys(FLAG_COUNTS, 0) if flagged else flag_counts(errors, ~ok)),
            "tips_mm": [
                round(value, 3) if np.isfinite(value) else None for value in errors.tolist()
            ],
        }
    return found


def _pct(so: bool | np.bool_) -> float:
    return 100.0 * bool(so)


def _lateral_mm(point: np.ndarray, place: tuple[float, float], K: np.ndarray) -> float:
    if not np.isfinite(point).all() or point[2] <= 0:
        return float("inf")
    off = (point[:2] / point[2] - (np.array(place) - K[:2, 2]) / np.diag(K)[:2]) * point[2]
    return 1e3 * float(np.hypot(*off))


def still_row(called: str, lost: bool, allowed: Sequence[str]) -> dict[str, Any]:
    """The figures of one still.  called: its gesture.  allowed: what it may be called."""
    return {
        "found_pct": _pct(not lost),
        "named_pct": _pct(not lost and called in allowed),
        "wrong_name_pct": _pct(not lost and called not in (*allowed, *UNNAMED)),
    }


def tip_figures(rows: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """tips_median_mm and tips_mean_mm of labelled frames, means over their seeds."""
    medians, means = [], []
    for seed in dict.fromkeys(row["seed"] for row in rows):
        off = [v for row in rows if row["seed"] == seed for v in row.get("tips_mm", ())]
        known = np.array([np.inf if value is None else value for value in off])
        if np.isfinite(known).any():
            medians.append(figure(known, np.median))
            means.append(figure(known[np.isfinite(known)]))
    return {"tips_median_mm": mean_of(medians), "tips_mean_mm": mean_of(means)}
