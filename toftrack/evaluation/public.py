"""How accurate the tracker is on a public data set: `toftrack evaluate MSRA15 FOLDER`.

Each sequence is tracked from its first frame by a tracker of its own, with the side of the data
set's hands, which are always in view. The figures are those of trust.py and of all frames with an
estimate, lost or not, over the joints that the labels share with toftrack, its fingertips moved to
where the data set has them.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from toftrack.api import make_tracker
from toftrack.evaluation.datasets import FPS, DataSet, LabelledSequence
from toftrack.evaluation.results import plain, table_of
from toftrack.evaluation.runs import Reported, estimates_of, kept
from toftrack.evaluation.statistics import figure, interval, mean_of, share_pct
from toftrack.evaluation.trust import OK_MM, TIPS, judged, tips_inset, trust
from toftrack.frames.frame import Truth

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


def evaluate(
    data_set: DataSet,
    sequences: Sequence[LabelledSequence],
    overrides: Sequence[str],
    tip_inset_m: float,
    frames: int | None = None,
) -> dict[str, dict[str, Any]]:
    """Track sequences and compare them with their labels; the figures by the sequences' names.

    overrides: of the configuration; hand.side among them goes before the data set's.  tip_inset_m:
    of `tips_inset`.  frames: so many at the start of each sequence only.
    Raises ToftrackError: an override or a file cannot be used.
    """
    counts = [len(sequence.joints_m[:frames]) for sequence in sequences]
    figures = {}
    with tqdm(total=sum(counts), unit=" frames", file=sys.stderr, disable=None) as bar:
        for sequence, count in zip(sequences, counts, strict=True):
            bar.set_postfix_str(sequence.name, refresh=False)
            if sequence.left_out:
                note = f"{sequence.left_out} labels have no image and are left out"
                bar.write(f"note: {sequence.name}: {note}", file=sys.stderr)
            tracker = make_tracker(f"hand.side={sequence.side}", *overrides)
            reported: Reported = []
            for index in range(count):
                depth_m, time_s = sequence.frame(index), index / FPS
                reported.append((kept(tracker.step(depth_m, sequence.camera.K, index, time_s)),))
                bar.update()
            found = estimates_of(reported)
            joints = tips_inset(found.joints_m, tip_inset_m)[:, list(data_set.joints)]
            true = sequence.joints_m[:count]
            figures[sequence.name] = labelled_figures(joints, found.lost, true, data_set.joints)
    return figures


def labelled_figures(
    joints_m: np.ndarray, lost: np.ndarray, true_m: np.ndarray, joints: tuple[int, ...]
) -> dict[str, Any]:
    """The figures of one sequence, JSON-able, unrounded; None for errors of no frame.

    Frames without an estimate (`missing_pct`) are never `within_pct`, where every joint is within
    40 mm. joints_m, true_m: (T, J, 3) metres, joints as the labels define them, not finite where
    there is no estimate.  lost: (T,) bool.  joints: which of toftrack's joints the J are.
    """
    every = np.ones(len(true_m), bool)
    frames = judged(joints_m, lost, Truth(true_m, every, every))
    of, error = trust(frames), frames.error_mm[frames.there]
    within = frames.error_mm.max(1) <= OK_MM
    return {
        "frames": of.frames,
        "missing_pct": share_pct(~frames.there, every) or 0.0,
        "mean_mm": figure(error),
        "median_mm": figure(error, np.median),
        "fingertip_mm": figure(error[:, np.isin(joints, TIPS)]),
        "within_pct": share_pct(within, every) or 0.0,
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
        total[name] = mean_of([row[name] for row in rows])
    for name in ("usable_pct", "silent_pct"):
        share = interval([row[name] for row in rows])
        total[f"{name.removesuffix('_pct')}_90"] = [share.low, share.high]
    return total


def table(sequences: Mapping[str, dict[str, Any]]) -> str:
    """One row a sequence and one of their means, without final newline. Shares in per cent."""
    mean = {"mean": totals(sequences)} if len(sequences) > 1 else {}
    return plain(table_of(_COLUMNS, {**sequences, **mean}, "sequence"))
