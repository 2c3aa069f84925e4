"""How good a track of a public data set is: its joint errors and what a user gets, as a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from toftrack.output.accuracy_tables import plain, table_of
from toftrack.output.evaluation import TIPS
from toftrack.output.trust import OK_MM, Hand, interval, trust

_PERCENT = ("within_pct", "usable_pct", "partly_pct", "silent_pct", "false_alarm_pct")
_COLUMNS = (
    ("frames", "frames", 0),
    ("mean mm", "mean_mm", 1),
    ("median", "median_mm", 1),
    ("tips", "fingertip_mm", 1),
    ("all<40", "within_pct", 1),
    ("usable", "usable_pct", 1),
    ("silent", "silent_pct", 1),
    ("false al.", "false_alarm_pct", 1),
    ("first right", "first_right", 0),
)


def labelled_figures(
    joints_m: np.ndarray, lost: np.ndarray, true_m: np.ndarray, joints: tuple[int, ...]
) -> dict[str, Any]:
    """The figures of one sequence in which the hand is always in view, JSON-able, unrounded.

    Errors are over all frames with an estimate, lost or not, None where there is none; frames
    without one (`missing_pct`) are never `within_pct`, where every joint is within 40 mm. The
    others are those of trust.py.

    Args:
        joints_m: (T, J, 3) estimates in metres, with joints as the labels define them; not finite
            where there is none.
        lost: (T,) bool.
        true_m: (T, J, 3) labels in metres.
        joints: which of toftrack's joints the J are.

    Raises:
        ToftrackError: the shapes do not fit.
    """
    of = trust(joints_m, lost, Hand(true_m, np.ones(len(true_m), bool)))
    finite = np.isfinite(joints_m).all(axis=(1, 2))
    error = 1e3 * np.linalg.norm(joints_m[finite] - true_m[finite], axis=2)
    tips = error[:, np.isin(joints, TIPS)]
    count = max(len(finite), 1)
    return {
        "frames": len(finite),
        "missing_pct": 100.0 * float((~finite).sum()) / count,
        "mean_mm": float(error.mean()) if error.size else None,
        "median_mm": float(np.median(error)) if error.size else None,
        "fingertip_mm": float(tips.mean()) if tips.size else None,
        "within_pct": 100.0 * float((error.max(axis=1) <= OK_MM).sum()) / count,
        "mean_not_lost_mm": of.mean_mm,
        "first_right": of.first_right,
        **{name: getattr(of, name) for name in _PERCENT[1:]},
        "longest_silent": of.longest_silent,
    }


def totals(sequences: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Means over sequences, JSON-able, with 90 % intervals of the shares usable and silent."""
    rows = list(sequences.values())
    total: dict[str, Any] = {
        "sequences": len(rows),
        "frames": sum(row["frames"] for row in rows),
        "never_right": sum(row["first_right"] is None for row in rows),
    }
    for name in ("mean_mm", "median_mm", "fingertip_mm", "mean_not_lost_mm", *_PERCENT):
        values = [row[name] for row in rows if row[name] is not None]
        total[name] = float(np.mean(values)) if values else None
    for name in ("usable_pct", "silent_pct"):
        share = interval([row[name] for row in rows])
        total[f"{name.removesuffix('_pct')}_90"] = [share.low, share.high]
    return total


def table(sequences: Mapping[str, dict[str, Any]]) -> str:
    """One row a sequence and one of their means, without final newline. Shares in per cent."""
    mean = {"mean": totals(sequences)} if len(sequences) > 1 else {}
    return plain(table_of(_COLUMNS, {**sequences, **mean}, "sequence"))
