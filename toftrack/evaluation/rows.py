"""The accuracy of a tracker over recordings and seeds: rows, totals, groups.

A row is what was measured of one recording with one seed. A recording's figures are means over its
rows (of `longest_silent` the longest, of `first_right` over the rows that are right at all), totals
are means over recordings, and 90 % intervals come from resampling the recordings: what another seed
does is within them, what other recordings would do is what they are about. `never_right` of a
recording is the share of its rows that never are, of the total the sum of these shares;
`median_first_right` is over all rows, a never counted as 999.

What joint_ok flags of wrong and of right fingertips (`wrong_flagged_pct`, `right_flagged_pct`) is
pooled over all rows, as wrong ones are rare; `tips_wrong` and `tips_right` are how many a seed has.

Groups (sensor, pose, distance, length of the hand) pool the visible frames of all rows instead; the
number of frames that is given with them is that of one seed on average.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from toftrack.evaluation.figures import IMAGE_MEANS, MEANS, SHARES, keys_over
from toftrack.evaluation.image_labels import tip_figures
from toftrack.evaluation.measures import FLAG_COUNTS, Measured, MeasuredRecording
from toftrack.evaluation.statistics import interval, mean_of, rounded
from toftrack.frames.frame import Truth

Row = dict[str, Any]
"""One recording with one seed: `recording`, `seed`, figures (None: about nothing), `groups`."""

_POOLED = ("seed", *FLAG_COUNTS)
NEVER = 999
_DISTANCES_M = (0.3, 0.4, 0.5, 0.6, 0.7)
_LENGTHS_MM = (150, 165, 180, 195)
_MIDDLE = (0, 9, 10, 11, 12)
"""The joints from the wrist to the middle finger's tip."""


def row_figures(found: MeasuredRecording, compute_s: np.ndarray) -> Row:
    """The figures of a row.  compute_s: (T,) seconds of each frame; NaN where nobody says."""
    first = found.first
    figures = _figures_of_hand(first) | {
        "frames": first.trust.frames,
        "visible": first.trust.visible,
        "longest_silent": first.trust.longest_silent,
        "first_right": first.trust.first_right,
        "never_right": float(first.trust.first_right is None) if first.trust.visible else None,
    }
    if found.second is not None:
        second = _figures_of_hand(found.second)
        figures |= {f"second_{name}": second[name] for name in ("usable_pct", "silent_pct")}
    if found.ghost_pct is not None:
        figures["ghost_pct"] = found.ghost_pct
    known = compute_s[np.isfinite(compute_s)]
    if len(known):
        figures["median_ms"] = 1e3 * float(np.median(known))
        figures["p90_ms"] = 1e3 * float(np.percentile(known, 90))
    return {name: rounded(value) for name, value in figures.items()}


def flag_figures(rows: Sequence[Row]) -> Row:
    """What joint_ok flags of fingertips, pooled; see the head of this module."""
    known = [row for row in rows if row.get("tips_right") is not None]
    seeds = len({row["seed"] for row in known})
    found: Row = {}
    for kind in ("wrong", "right") if known else ():
        count, flagged = (
            sum(row[name] for row in known) for name in (f"tips_{kind}", f"tips_{kind}_flagged")
        )
        found[f"tips_{kind}"] = round(count / seeds)
        found[f"{kind}_flagged_pct"] = rounded(100 * flagged / count) if count else None
    return found


def _figures_of_hand(of: Measured) -> Row:
    seen = of.trust.visible > 0
    figures: Row = {
        name: getattr(of.trust, name) if seen or name == "silent_pct" else None
        for name in (*SHARES, "mean_mm", "mean_all_mm")
    }
    for name, value in of.figures.items():
        share = isinstance(value, bool)
        figures[f"{name}_pct" if share else name] = 100.0 * value if share else value
    return figures


def group_counts(
    of: Measured, truth: Truth, sensor: str, length_mm: float | None
) -> dict[str, dict[str, dict[str, float]]]:
    """By kind of group and group: the visible frames of a row, and what they are.  length_mm: of
    the hand, wrist to middle fingertip; None: by the truth."""
    kinds = [share.removesuffix("_pct") for share in SHARES]
    flags = {kind: getattr(of.frames, kind) for kind in kinds}
    flags |= {"named": of.named, "called_right": of.called, "said": of.frames.seen & of.frames.said}
    distance = np.asarray(truth.joints_m, np.float64)[:, :, 2].mean(1)
    length = _length_mm(truth) if length_mm is None else length_mm
    poses = np.full(len(distance), "") if truth.pose_name is None else truth.pose_name
    of_frames = {
        "sensor": np.full(len(distance), sensor),
        "pose": np.asarray(poses, str),
        "distance": np.array([_band(d, _DISTANCES_M, "m") for d in distance]),
        "hand length": np.full(len(distance), _band(length, _LENGTHS_MM, "mm")),
    }
    counts: dict[str, dict[str, dict[str, float]]] = {}
    for kind, names in of_frames.items():
        for name in sorted(set(names[of.frames.seen].tolist()) - {""}):
            rows = of.frames.seen & (names == name)
            mine: dict[str, float] = {"frames": int(rows.sum())}
            mine |= {flag: int((values & rows).sum()) for flag, values in flags.items()}
            mine["error_sum_mm"] = round(float(of.frames.mean_mm[rows & of.frames.said].sum()), 3)
            counts.setdefault(kind, {})[name] = mine
    return counts


def by_recording(rows: Sequence[Row]) -> dict[str, Row]:
    """Each recording's figures over its seeds, see the head of this module."""
    each: dict[str, Row] = {}
    for name in dict.fromkeys(row["recording"] for row in rows):
        mine = [row for row in rows if row["recording"] == name]
        keys = dict.fromkeys(
            key
            for row in mine
            for key, value in row.items()
            if key not in _POOLED and (value is None or isinstance(value, int | float))
        )
        each[name] = {key: rounded(mean_of([row.get(key) for row in mine])) for key in keys}
        for key in keys_over("largest"):
            if values := [row[key] for row in mine if row.get(key) is not None]:
                each[name][key] = max(values)
        each[name] |= flag_figures(mine)
    return each


def totals(rows: Sequence[Row]) -> dict[str, Any]:
    """Of all recordings, see the head of this module; `usable_90` and its like are intervals."""
    each = list(by_recording(rows).values())
    total: dict[str, Any] = {
        "recordings": len(each),
        "seeds": len({row["seed"] for row in rows}),
    }
    for key in keys_over("count"):
        total[key] = round(sum(row.get(key) or 0 for row in each))
    total |= _means(each, MEANS) | flag_figures(rows)
    for key in keys_over("largest"):
        total[key] = max((row.get(key) or 0 for row in each), default=0)
    for key in keys_over("sum"):
        total[key] = rounded(sum(row.get(key) or 0.0 for row in each))
    firsts = [row["first_right"] for row in rows if row.get("never_right") is not None]
    counted = [NEVER if first is None else first for first in firsts]
    total["median_first_right"] = float(np.median(counted)) if counted else None
    return total


def _means(each: Sequence[Row], keys: Sequence[str]) -> dict[str, Any]:
    """Of recordings, with intervals where there are several."""
    found: dict[str, Any] = {}
    for key in keys:
        values = [row[key] for row in each if row.get(key) is not None]
        if values:
            share = interval(values)
            found[key] = rounded(share.mean)
            if len(values) > 1:
                found[interval_name(key)] = [rounded(share.low), rounded(share.high)]
    return found


def image_totals(rows: Sequence[Row]) -> dict[str, Any]:
    """Of labelled images, each of which counts as a recording: see image_labels.py."""
    each = list(by_recording(rows).values())
    total: dict[str, Any] = {"images": len(each), "seeds": len({row["seed"] for row in rows})}
    total |= _means(each, IMAGE_MEANS)
    for key in IMAGE_MEANS:
        # What a seed changes: the least and the largest of its means.
        of_seeds = [
            mean_of([row.get(key) for row in rows if row["seed"] == seed])
            for seed in dict.fromkeys(row["seed"] for row in rows)
        ]
        known = [value for value in of_seeds if value is not None]
        if known:
            total[f"{key.removesuffix('_pct')}_seeds"] = [rounded(f(known)) for f in (min, max)]
    return (
        total
        | flag_figures(rows)
        | {name: rounded(value) for name, value in tip_figures(rows).items() if value is not None}
    )


def interval_name(key: str) -> str:
    """Under which key a figure's interval stands."""
    stem, _, unit = key.rpartition("_")
    return f"{stem}_90" if unit == "pct" else f"{key}_90"


def groups(rows: Sequence[Row]) -> dict[str, dict[str, Row]]:
    """By kind of group and group: figures over its frames, pooled; see the head of this module.
    Bands are in the order of their values, other groups in that of their names."""
    sums: dict[str, dict[str, Counter]] = {}
    for row in rows:
        for kind, found in row.get("groups", {}).items():
            for name, counts in found.items():
                sums.setdefault(kind, {}).setdefault(name, Counter()).update(counts)
    seeds = max(len({row["seed"] for row in rows}), 1)
    return {
        kind: {
            name: _group_figures(found[name], seeds)
            for name in sorted(found, key=lambda name: (not name.startswith("below "), name))
        }
        for kind, found in sums.items()
    }


def _group_figures(counts: Mapping[str, float], seeds: int) -> Row:
    def pct(part: str, whole: str) -> float | None:
        return rounded(100 * counts[part] / counts[whole]) if counts[whole] else None

    said = counts["said"]
    return {
        "frames": round(counts["frames"] / seeds),
        **{share: pct(share.removesuffix("_pct"), "frames") for share in SHARES},
        "mean_mm": rounded(counts["error_sum_mm"] / said) if said else None,
        "gesture_pct": pct("called_right", "named"),
    }


def _length_mm(truth: Truth) -> float:
    bones = np.diff(np.asarray(truth.joints_m, np.float64)[:, _MIDDLE], axis=1)
    return 1e3 * float(np.median(np.linalg.norm(bones, axis=2).sum(1)))


def _band(value: float, ends: Sequence[float], unit: str) -> str:
    """Which band a value is in."""
    above = sum(not value < end for end in ends)  # a length that is not known is above all
    if above == 0:
        return f"below {ends[0]:g} {unit}"
    low = ends[above - 1]
    return f"{low:g} {unit} and more" if low == ends[-1] else f"{low:g} to {ends[above]:g} {unit}"
