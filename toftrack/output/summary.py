"""What summary.json and the terminal say of a run: frames, the time they took, how good they are.

Of a run with several slots a frame is lost when none has a hand that can be used, and the mean
score is that of the hands that are there; `slots` says the same of each. The metrics are those of
the recording's first hand, in the slot that followed it; under `second` stand those of its other
hand, and where there are more slots than hands, `ghost_pct` says how often another slot had one all
the same. What evaluation/measures.py adds to trust.py stands under `further`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, fields
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.evaluation.measures import REGION_FIGURES, Estimates, Measured, evaluate, measured
from toftrack.evaluation.statistics import figure, text_of
from toftrack.evaluation.trust import RIGHT_FRAMES
from toftrack.frames.frame import Truth
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, HandShape
from toftrack.output.records import Records
from toftrack.recordings.doubts import times_doubt


def shape_file(slot: int) -> str:
    """The name of the file with the fitted hand of a slot."""
    return "hand_shape.json" if slot == 0 else f"hand_shape_{slot + 1}.json"


def summarise(
    records: Records, rows: int, dropped: int, folder: Path, metadata: dict[str, Any]
) -> dict[str, Any]:
    """The summary without metrics, of so many frames of the input; the hands' files are in the
    folder.
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
        "mean_score": figure(scores[there] if records.slots > 1 else scores),
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
            "mean_score": figure(scores[here, slot]),
        }
        slots.append(of_slot | (_hand(folder, slot, metadata) if here.any() else {}))
    return summary | {"slots": slots}


def _hand(folder: Path, slot: int, metadata: dict[str, Any]) -> dict[str, Any]:
    """The hand that was tracked, where its file is in the folder."""
    shape = _shape(folder, slot)
    if shape is None:
        return {}
    fits = (metadata.get("hand_shape") or {}).get("fitted")
    fitted = bool(fits) and shape.fitted is not None
    return {"hand": {"side": shape.side, "length_mm": 1e3 * shape.hand_length_m, "fitted": fitted}}


def _shape(folder: Path, slot: int) -> HandShape | None:
    try:
        return HandShape.load(folder / shape_file(slot))
    except ToftrackError:
        return None


def run_doubts(
    records: Records,
    folder: Path,
    metadata: dict[str, Any],
    apparent_m: Sequence[float | None] = (),
) -> list[str]:
    """What speaks against a run's input, a sentence each: what its device found, or the frames'
    times, and how long the fitted hands are, or seemed where they were mostly lost (apparent_m).
    """
    configured = (metadata.get("device") or {}).get("doubts")
    found = [times_doubt(records.column("timestamp_s"))] if configured is None else list(configured)
    k = (metadata.get("camera") or {}).get("K")
    if (metadata.get("hand_shape") or {}).get("fitted") and k is not None:
        for slot, apparent in zip_longest(range(records.slots), apparent_m):
            fitted = length_doubt(_shape(folder, slot), np.array(k))
            found.append(fitted or apparent_doubt(apparent, np.array(k)))
    return list(filter(None, found))


def run_metrics(
    records: Records, rows: np.ndarray, index: np.ndarray, truth: Truth, counted: np.ndarray
) -> dict[str, Any] | None:
    """The metrics over those frames that count (T,) and whose numbers (index) the truth has; None
    where it has none of them.
    """
    true = index - truth.first
    inside = (true >= 0) & (true < len(truth))
    known = counted & inside
    if not known.any():
        return None
    numbers = index[known]
    found = truth.of_frames(index[known])
    done = {field.name: records.column(field.name, rows[known]) for field in fields(Estimates)}
    sure = done["side_probability"]
    if (sure[np.isfinite(sure)] == 1).all():  # a side that was given is no finding
        done = {name: array for name, array in done.items() if not name.startswith("side")}
    estimates = Estimates(**done)
    both = measured(estimates, found)
    if both.slots is None:
        return _metrics(both.first, estimates, found, numbers)
    first = _metrics(both.first, estimates.slot(both.slots[0]), found, numbers)
    metrics = {"slot": both.slots[0]} | first
    if both.ghost_pct is not None:
        metrics["ghost_pct"] = both.ghost_pct
    if both.second is None or found.other is None:
        return metrics
    second = _metrics(both.second, estimates.slot(both.slots[1]), found.other, numbers)
    return metrics | {"second": {"slot": both.slots[1]} | second}


def _metrics(
    of: Measured, estimates: Estimates, truth: Truth, numbers: np.ndarray
) -> dict[str, Any]:
    """Of one hand; numbers: (T,) of the frames, as the recording counts them."""
    metrics = {"trust": asdict(of.trust)} | evaluate(estimates.joints_m, estimates.lost, truth)
    for event in metrics["reacquisition"]:
        event["frame"] = int(numbers[event["frame"]])
    metrics["coverage"] = {name: of.figures.get(name) for name in REGION_FIGURES}
    further = {name: value for name, value in of.figures.items() if name not in REGION_FIGURES}
    return metrics | {"further": further}


_SMALLEST_M, _LARGEST_M = 0.145, 0.210
"""Hands between these are no reason to doubt: of children from about ten years on, and of all but
one man in a hundred (ANSUR II)."""
_SIGMAS = 2.0
"""So sure must a fit be that the hand lies beyond."""
_APPARENT_M = (0.135, 0.215)
"""Likewise of what the networks say of a hand that was lost, whose lengths stay nearer to the
usual."""


def length_doubt(shape: HandShape | None, k: np.ndarray) -> str:
    """What speaks against the camera matrix k (3, 3), px, where a hand was fitted; "": nothing."""
    if shape is None or shape.fitted is None:
        return ""
    length, factor = shape.hand_length_m, math.exp(_SIGMAS * shape.fitted.sigma[0])
    if _SMALLEST_M <= length * factor and length / factor <= _LARGEST_M:
        return ""
    return _sentence(f"the fitted hand is {1e3 * length:.0f} mm long", length, k)


def apparent_doubt(length_m: float | None, k: np.ndarray) -> str:
    """Likewise by the mean length that the networks gave a hand that was lost in most frames."""
    if length_m is None or _APPARENT_M[0] <= length_m <= _APPARENT_M[1]:
        return ""
    return _sentence(f"the hand looks {1e3 * length_m:.0f} mm long", length_m, k)


def _sentence(what: str, length_m: float, k: np.ndarray) -> str:
    small = length_m < DEFAULT_HAND_LENGTH_M
    usual, focal = 1e3 * DEFAULT_HAND_LENGTH_M, float(np.asarray(k)[0, 0])
    whose = "only small children's hands are" if small else "hardly anybody's hand is"
    wrong = "large" if small else "small"
    return (
        f"{what}, as {whose}: otherwise the focal length is too {wrong}, or the depth is in "
        f"another unit; fx = {focal * length_m / DEFAULT_HAND_LENGTH_M:.4g} instead of {focal:.4g} "
        f"pixels would make it {usual:.0f} mm (camera.file=FILE, or K of the recording)"
    )


def metrics_table(summary: dict[str, Any]) -> str:
    """The content of summary.json as a short table, without final newline."""
    rows = [
        ("frames", _frames_text(summary)),
        ("time a frame", _time_text(summary)),
        ("mean score", text_of(summary["mean_score"], 3)),
    ]
    if hand := summary.get("hand"):
        rows.append(("hand", _hand_text(hand)))
    for slot in summary.get("slots", ()):
        about = f"{_hand_text(slot['hand'])}; " if "hand" in slot else ""
        frames = f"in {slot['frames']} frames, {slot['lost_frames']} of them lost"
        rows.append((f"slot {slot['slot']}", about + frames))
    if metrics := summary.get("metrics"):
        rows = _trust_rows(metrics["trust"]) + rows + _error_rows(metrics)
        if metrics.get("ghost_pct") is not None:
            rows.append(("a hand where there is none", f"{text_of(metrics['ghost_pct'])} %"))
        if second := metrics.get("second"):
            rows.append(("the other hand", f"in slot {second['slot']}"))
            rows += _trust_rows(second["trust"]) + _error_rows(second)
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {text}" for name, text in rows)


def metrics_line(summary: dict[str, Any]) -> str:
    """The same in a line, for the jobs of a sweep."""
    parts = [
        f"{summary['frames']} frames",
        f"{summary['lost_frames']} lost",
        f"{text_of(summary['median_ms'])} ms a frame",
        f"mean score {text_of(summary['mean_score'], 3)}",
    ]
    if metrics := summary.get("metrics"):
        parts.append(f"usable {text_of(metrics['trust']['usable_pct'])} %")
        parts.append(f"joint error {text_of(metrics['trust']['mean_mm'])} mm")
    return ", ".join(parts)


def _time_text(summary: dict[str, Any]) -> str:
    mean, median = summary["mean_ms"], summary["median_ms"]
    if not median or mean < 2 * median:
        return f"{text_of(mean)} ms ({text_of(summary['fps'])} frames/s)"
    once = f"the mean, {text_of(mean)} ms, includes compiling and loading once"
    return f"{text_of(median)} ms ({text_of(1e3 / median)} frames/s), the median; {once}"


def _frames_text(summary: dict[str, Any]) -> str:
    text = f"{summary['frames']}, {summary['lost_frames']} of them lost"
    if dropped := summary.get("dropped_frames"):
        text += f", {dropped} dropped"
    if reduced := (summary.get("realtime") or {}).get("reduced_frames"):
        text += f", {reduced} tracked with reduced effort"
    return text


def _hand_text(hand: dict[str, Any]) -> str:
    fitted = ", fitted" if hand["fitted"] else ""
    return f"{hand['side']}, {text_of(hand['length_mm'], 0)} mm long{fitted}"


def _trust_rows(trust: dict[str, Any]) -> list[tuple[str, str]]:
    """The headline: names and texts."""
    first, longest, seen = trust["first_right"], trust["longest_silent"], trust["visible"]
    silent = text_of(trust["silent_pct"] if trust["frames"] else None)
    usable, alarms = (
        text_of(trust[name] if seen else None) for name in ("usable_pct", "false_alarm_pct")
    )
    short = trust["frames"] < RIGHT_FRAMES
    never = f"- (of {RIGHT_FRAMES} frames in a row)" if short else "never"
    right = never if first is None else f"in frame {first}"
    partly = (
        f"; in {text_of(trust['partly_pct'])} % some joints are over 40 mm off, their mean is not"
    )
    between = partly if trust["partly_pct"] > 0 else ""
    in_a_row = f", up to {longest} frames in a row" if longest else ""
    rows = [
        ("usable", f"{usable} % of the {seen} visible frames{between}"),
        ("silently wrong", f"{silent} %{in_a_row}"),
        ("false alarms", f"{alarms} %"),
        ("joint error", f"{text_of(trust['mean_mm'])} mm, of visible frames that are not lost"),
        ("first right", right if seen else "-"),
    ]
    after = ["never" if frames is None else str(frames) for frames in trust["found_after"]]
    if after:
        rows.append(("found again", f"after {', '.join(after)} frames"))
    return rows


def _error_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """Errors, regions, flags and when the hand was found again: names and texts."""
    rows: list[tuple[str, str]] = []
    if metrics["frames"]:
        wrists = f"{text_of(metrics['wrist_aligned_mm'])} mm, after moving wrist onto wrist"
        rows = [
            ("in the pose space", f"{metrics['frames']} frames from the sixth on, which have:"),
            ("joint error, mean", f"{text_of(metrics['mean_mm'])} mm"),
            ("joint error, median", f"{text_of(metrics['median_mm'])} mm"),
            ("fingertip error", f"{text_of(metrics['fingertip_mm'])} mm"),
            ("wrist-aligned error", wrists),
            ("frames below 40 mm", f"{text_of(metrics['frames_max_below_40mm_pct'])} %"),
        ]
    if metrics["missing_pct"]:
        rows.append(("without estimate", f"{text_of(metrics['missing_pct'])} %"))
    coverage, further = metrics["coverage"], metrics["further"]
    if (inside := coverage["in_region_90_pct"]) is not None:
        hidden = coverage["hidden_in_region_90_pct"]
        of_hidden = "" if hidden is None else f", {text_of(hidden)} % of the hidden ones"
        rows.append(("in their 90 % region", f"{text_of(inside)} % of the joints{of_hidden}"))
    if "tips_right" in further:
        counts = (
            f"{further[f'tips_{kind}_flagged']} of {further[f'tips_{kind}']} {kind}"
            for kind in ("wrong", "right")
        )
        rows.append(("joint_ok flags", f"{', '.join(counts)} fingertips"))
    for event in metrics["reacquisition"]:
        delay = "never" if event["delay"] is None else f"after {event['delay']} frames"
        rows.append((f"{event['event']} at {event['frame']}", f"tracked {delay}"))
    return rows
