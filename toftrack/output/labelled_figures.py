"""How good a track of a public data set is: its joint errors and what a user gets, as a table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from toftrack.output.evaluation import TIPS
from toftrack.output.trust import OK_MM, Hand, Trust, interval, trust

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


@dataclass(frozen=True)
class LabelledFigures:
    """The figures of one sequence. Errors are over all frames with an estimate, lost or not."""

    frames: int
    missing_pct: float
    """Frames without an estimate: left out of the errors, and never within 40 mm."""
    mean_mm: float | None
    """Over all compared joints; None: there is no estimate at all."""
    median_mm: float | None
    fingertip_mm: float | None
    within_pct: float
    """Frames in which every compared joint is within 40 mm, lost or not."""
    trust: Trust

    def as_dict(self) -> dict[str, Any]:
        """JSON-able, the figures of `trust` among the others; unrounded."""
        own = {name: value for name, value in vars(self).items() if name != "trust"}
        not_lost = {"mean_not_lost_mm": self.trust.mean_mm, "first_right": self.trust.first_right}
        shares = {name: getattr(self.trust, name) for name in _PERCENT if name != "within_pct"}
        return own | not_lost | shares | {"longest_silent": self.trust.longest_silent}


def labelled_figures(
    joints_m: np.ndarray, lost: np.ndarray, true_m: np.ndarray, joints: tuple[int, ...]
) -> LabelledFigures:
    """The figures of one sequence in which the hand is always in view.

    Args:
        joints_m: (T, J, 3) estimates in metres, with joints as the labels define them; not finite
            where there is none.
        lost: (T,) bool.
        true_m: (T, J, 3) labels in metres.
        joints: which of toftrack's joints the J are.

    Raises:
        ToftrackError: the shapes do not fit.
    """
    figures = trust(joints_m, lost, Hand(true_m, np.ones(len(true_m), bool)))
    finite = np.isfinite(joints_m).all(axis=(1, 2))
    error = 1e3 * np.linalg.norm(joints_m[finite] - true_m[finite], axis=2)
    tips = error[:, np.isin(joints, TIPS)]
    count = max(len(finite), 1)
    return LabelledFigures(
        frames=len(finite),
        missing_pct=100.0 * float((~finite).sum()) / count,
        mean_mm=float(error.mean()) if error.size else None,
        median_mm=float(np.median(error)) if error.size else None,
        fingertip_mm=float(tips.mean()) if tips.size else None,
        within_pct=100.0 * float((error.max(axis=1) <= OK_MM).sum()) / count,
        trust=figures,
    )


def totals(sequences: Mapping[str, LabelledFigures]) -> dict[str, Any]:
    """Means over sequences, JSON-able, with 90 % intervals of the shares usable and silent."""
    rows = [figures.as_dict() for figures in sequences.values()]
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


def table(sequences: Mapping[str, LabelledFigures]) -> str:
    """One row a sequence and one of their means, without final newline. Shares in per cent."""
    rows = {name: figures.as_dict() for name, figures in sequences.items()}
    if len(rows) > 1:
        rows["mean"] = totals(sequences)
    width = max(len("sequence"), *(len(name) for name in rows))
    lines = ["  ".join([f"{'sequence':<{width}}", *(title for title, _, _ in _COLUMNS)])]
    for name, row in rows.items():
        cells = [f"{_text(row.get(key), digits):>{len(title)}}" for title, key, digits in _COLUMNS]
        lines.append("  ".join([f"{name:<{width}}", *cells]))
    return "\n".join(lines)


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
