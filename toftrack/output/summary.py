"""What summary.json says of a run: how many frames, how long they took, and how good they are.

Of a run with two slots a frame is lost when no slot has a hand that can be used, and the mean score
is that of the hands that are there; `slots` says the same of each. The metrics are those of the
recording's first hand, in the slot that followed it; under `second` stand those of its other hand,
or, where the recording has one hand, `ghost_pct` says how often the other slot had one all the
same.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.frames import Truth
from toftrack.hand.shape import HandShape
from toftrack.output.coverage import coverage
from toftrack.output.evaluation import evaluate
from toftrack.output.records import Records
from toftrack.output.trust import Hand, Trust, trust, trust_of_two


def shape_file(slot: int) -> str:
    """The name of the file with the fitted hand of a slot."""
    return "hand_shape.json" if slot == 0 else f"hand_shape_{slot + 1}.json"


def summarise(
    records: Records, rows: int, dropped: int, folder: Path, metadata: dict[str, Any]
) -> dict[str, Any]:
    """The summary without metrics.

    rows: frames of the input.  dropped: how many of them were.  folder: where the hands' files are.
    """
    done = records.count
    seconds = records.column("compute_s").astype(np.float64)
    # One slot is one of one: (T, S).
    scores = records.column("score").astype(np.float64).reshape(done, records.slots)
    lost = records.column("lost").reshape(done, records.slots)
    there = np.isfinite(scores)
    total = float(seconds.sum())
    summary = {
        "frames": rows,
        "lost_frames": int(lost.all(1).sum()),
        "dropped_frames": dropped,
        "mean_ms": 1e3 * float(seconds.mean()) if done else None,
        "median_ms": 1e3 * float(np.median(seconds)) if done else None,
        "fps": done / total if total > 0 else None,
        "mean_score": _mean(scores[there] if records.slots > 1 else scores),
    }
    if records.slots == 1:
        return summary | _hand(folder, 0, metadata)
    slots = []
    for slot in range(records.slots):
        here = there[:, slot]
        of_slot = {
            "slot": slot,
            "frames": int(here.sum()),
            "lost_frames": int((lost[:, slot] & here).sum()),
            "mean_score": _mean(scores[here, slot]),
        }
        slots.append(of_slot | (_hand(folder, slot, metadata) if here.any() else {}))
    return summary | {"slots": slots}


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if values.size else None


def _hand(folder: Path, slot: int, metadata: dict[str, Any]) -> dict[str, Any]:
    """The hand that was tracked, where its file is in the folder."""
    try:
        shape = HandShape.load(folder / shape_file(slot))
    except ToftrackError:
        return {}
    fitted = bool((metadata.get("hand_shape") or {}).get("fitted"))
    return {"hand": {"side": shape.side, "length_mm": 1e3 * shape.hand_length_m, "fitted": fitted}}


def run_metrics(
    records: Records, rows: np.ndarray, index: np.ndarray, truth: Truth, counted: np.ndarray
) -> dict[str, Any] | None:
    """The metrics over those frames that count and whose numbers the truth has; None where it has
    none of them.

    rows: records.  index: numbers of their frames.  counted: (T,) bool of them.
    """
    true = index - truth.first
    inside = (true >= 0) & (true < len(truth))
    known = counted & inside
    if not known.any():
        return None
    position = np.flatnonzero(counted[inside])
    found = truth.of_frames(index[known])
    names = ("joints_m", "lost", "joint_sigma_m")
    arrays = {n: records.column(n, rows[known]) for n in names if n in records.names}
    if records.slots == 1:
        figures = trust(arrays["joints_m"], arrays["lost"], _hand_of(found))
        return _metrics(figures, arrays, found, position)
    truths = [found] if found.other is None else [found, found.other]
    both = trust_of_two(arrays["joints_m"], arrays["lost"], [_hand_of(one) for one in truths])
    of_slots = [{n: array[:, slot] for n, array in arrays.items()} for slot in both.slots]
    metrics = {"slot": both.slots[0]} | _metrics(both.first, of_slots[0], found, position)
    if both.second is None:
        return metrics | {"ghost_pct": both.ghost_pct}
    second = {"slot": both.slots[1]} | _metrics(both.second, of_slots[1], truths[1], position)
    return metrics | {"second": second}


def _hand_of(truth: Truth) -> Hand:
    return Hand(truth.joints_m, truth.visible)


def _metrics(
    figures: Trust, arrays: dict[str, np.ndarray], truth: Truth, position: np.ndarray
) -> dict[str, Any]:
    """Of the estimates of one hand, arrays of (T, ...).

    position: (T,) of the frames among all, with those that do not count.
    """
    joints = arrays["joints_m"]
    metrics = {"trust": asdict(figures)} | evaluate(joints, arrays["lost"], truth)
    for event in metrics["reacquisition"]:
        event["frame"] = int(position[event["frame"]])
    if "joint_sigma_m" in arrays:
        metrics["coverage"] = asdict(coverage(joints, arrays["joint_sigma_m"], truth))
    return metrics
