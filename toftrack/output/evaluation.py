"""How good an estimate is, measured against ground truth.

Errors are Euclidean distances per joint, in millimetres, over the frames in which the truth says
that the hand is visible and its pose in the pose space, from frame `skip` on. Frames flagged lost
count like any other, so that flagging cannot improve an error. Frames without a finite estimate
count as failures: they are left out of means and quantiles, reported as `missing_pct`, and never
count as good.

Re-acquisition is the number of frames from an event to the first of `reacquire_hold` consecutive
frames (fewer at the end of the recording) that are not flagged lost and have a mean joint error
below `reacquire_mm`; None when that does not happen before the hand is gone again, or at all.
Events:

- `return`: the hand becomes visible again;
- `entered`: after a return, the visible fraction first reaches 0.9;
- `unoccluded`: the visible fraction is back at 0.9 after a dip below 0.7, visible all the while;
- `in_space`: the pose enters the pose space again.

Lost detection calls a frame lost, in truth, when the hand is not visible or not in the pose space.
The tolerant figures leave out the frames within `tolerance` frames of a change of that truth; the
strict ones do not.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.frames import Truth

TIPS = (4, 8, 12, 16, 20)
"""Rows of the fingertips among the 21 joints."""

_BACK_IN_VIEW = 0.9
_COVERED = 0.7


def evaluate(
    joints_m: np.ndarray,
    lost: np.ndarray | None,
    truth: Truth,
    skip: int = 5,
    ok_mm: float = 40.0,
    reacquire_mm: float = 25.0,
    reacquire_hold: int = 3,
    tolerance: int = 3,
) -> dict[str, Any]:
    """Metrics of T estimates, unrounded; None for a figure about no frame at all.

    Args:
        joints_m: (T, 21, 3) metres, camera frame; NaN where there is no estimate.
        lost: (T,) bool, or None to leave out everything about lost frames.
        truth: of the same T frames.
        skip: frames at the start that do not count.
        ok_mm: the largest joint error of a good frame.
        reacquire_mm, reacquire_hold: mean error and number of frames that count as tracking again.
        tolerance: frames around a change of the truth that the tolerant lost figures leave out.

    Returns:
        frames, missing_pct, mean_mm, median_mm, p90_mm, fingertip_mm, wrist_aligned_mm (without the
        wrist), visible_joints_mm, frames_max_below_{ok_mm}mm_pct, reacquisition (a list of {event,
        frame, delay}), and with `lost` mean_not_lost_mm, lost_precision, lost_recall (tolerant),
        lost_precision_strict and lost_recall_strict.

    Raises:
        ToftrackError: estimates and truth differ in shape.
    """
    estimate = np.asarray(joints_m, np.float64)
    true = np.asarray(truth.joints_m, np.float64)
    if estimate.shape != true.shape:
        raise ToftrackError(
            f"the estimates have the shape {estimate.shape}, but the truth {true.shape}; evaluate "
            "the same frames of the same recording"
        )
    count = len(true)
    present = truth.visible & truth.in_space
    counted = np.arange(count) >= skip
    finite = np.isfinite(estimate).all(axis=(1, 2))
    used = present & counted
    measured = used & finite

    with np.errstate(invalid="ignore"):  # rows without an estimate; `measured` excludes them
        error = 1e3 * np.linalg.norm(estimate - true, axis=-1)
        relative = (estimate - estimate[:, :1]) - (true - true[:, :1])
        aligned = 1e3 * np.linalg.norm(relative, axis=-1)
    largest = np.where(finite, error.max(axis=1, initial=0.0), np.inf)
    average = np.where(finite, error.mean(axis=1), np.inf)

    metrics: dict[str, Any] = {
        "frames": int(used.sum()),
        "missing_pct": _share_pct(used & ~finite, used),
        "mean_mm": _mean(error[measured]),
        "median_mm": float(np.median(error[measured])) if measured.any() else None,
        "p90_mm": float(np.percentile(error[measured], 90)) if measured.any() else None,
        "fingertip_mm": _mean(error[measured][:, TIPS]),
        "wrist_aligned_mm": _mean(aligned[measured][:, 1:]),
        "visible_joints_mm": _mean(_in_sight(error, truth)[measured]),
        f"frames_max_below_{ok_mm:g}mm_pct": _share_pct(used & (largest < ok_mm), used),
    }
    tracking = average < reacquire_mm
    if lost is not None:
        lost = np.asarray(lost, bool)
        if lost.shape != (count,):
            raise ToftrackError(f"'lost' must have {count} rows, but has the shape {lost.shape}")
        tracking &= ~lost
        metrics["mean_not_lost_mm"] = _mean(error[measured & ~lost])
        clear = counted & ~_near_change(present, tolerance)
        for suffix, rows in (("", clear), ("_strict", counted)):
            precision, recall = _precision_recall(lost[rows], ~present[rows])
            metrics[f"lost_precision{suffix}"] = precision
            metrics[f"lost_recall{suffix}"] = recall
    metrics["reacquisition"] = [
        {"event": event, "frame": frame, "delay": _delay(tracking, present, frame, reacquire_hold)}
        for event, frame in _events(truth)
    ]
    return metrics


def metrics_table(summary: dict[str, Any]) -> str:
    """The content of summary.json as a short text table for the terminal, without final newline."""
    rows = [
        ("frames", _frames_text(summary)),
        ("time a frame", f"{_figure(summary['mean_ms'])} ms ({_figure(summary['fps'])} frames/s)"),
        ("mean score", _figure(summary["mean_score"], 3)),
    ]
    if hand := summary.get("hand"):
        rows.append(("hand", _hand_text(hand)))
    for slot in summary.get("slots", ()):
        about = f"{_hand_text(slot['hand'])}; " if "hand" in slot else ""
        frames = f"in {slot['frames']} frames, {slot['lost_frames']} of them lost"
        rows.append((f"slot {slot['slot']}", about + frames))
    metrics = summary.get("metrics")
    if metrics:
        if metrics.get("trust"):
            rows = _trust_rows(metrics["trust"]) + rows
        rows += _error_rows(metrics)
        if metrics.get("ghost_pct") is not None:
            rows.append(("another hand, where is none", f"{_figure(metrics['ghost_pct'])} %"))
        if second := metrics.get("second"):
            rows.append(("the other hand", f"in slot {second['slot']}"))
            rows += _trust_rows(second["trust"]) + _error_rows(second)
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {text}" for name, text in rows)


def metrics_line(summary: dict[str, Any]) -> str:
    """The same in a line, for the jobs of a sweep."""
    metrics = summary.get("metrics") or {}
    trust = metrics.get("trust") or {}
    parts = [
        f"{summary['frames']} frames",
        f"{summary['lost_frames']} lost",
        f"{_figure(summary['mean_ms'])} ms a frame",
        f"mean score {_figure(summary['mean_score'], 3)}",
    ]
    if trust:
        parts.append(f"usable {_figure(trust['usable_pct'])} %")
    if metrics:
        parts.append(f"joint error {_figure(metrics['mean_mm'])} mm")
    return ", ".join(parts)


def _frames_text(summary: dict[str, Any]) -> str:
    text = f"{summary['frames']}, {summary['lost_frames']} of them lost"
    if dropped := summary.get("dropped_frames"):
        text += f", {dropped} dropped"
    if reduced := (summary.get("realtime") or {}).get("reduced_frames"):
        text += f", {reduced} tracked with reduced effort"
    return text


def _hand_text(hand: dict[str, Any]) -> str:
    fitted = ", fitted" if hand["fitted"] else ""
    return f"{hand['side']}, {_figure(hand['length_mm'], 0)} mm long{fitted}"


def _error_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """What `evaluate` and `coverage` found: names and texts."""
    rows = [
        ("joint error, mean", f"{_figure(metrics['mean_mm'])} mm"),
        ("joint error, median", f"{_figure(metrics['median_mm'])} mm"),
        ("fingertip error", f"{_figure(metrics['fingertip_mm'])} mm"),
        ("wrist-aligned error", f"{_figure(metrics['wrist_aligned_mm'])} mm"),
    ]
    for name, value in metrics.items():
        if name.startswith("frames_max_below_"):
            limit = name.removeprefix("frames_max_below_").removesuffix("mm_pct")
            share = value if metrics["frames"] else None
            rows.append((f"frames below {limit} mm", f"{_figure(share)} %"))
    if metrics["missing_pct"]:
        rows.append(("without estimate", f"{_figure(metrics['missing_pct'])} %"))
    precision, recall = metrics.get("lost_precision"), metrics.get("lost_recall")
    if precision is not None or recall is not None:
        text = f"precision {_figure(precision, 2)}, recall {_figure(recall, 2)}"
        rows.append(("lost frames", text))
    rows += _region_rows(metrics.get("coverage")) + _flag_rows(metrics.get("further"))
    for event in metrics["reacquisition"]:
        delay = "never" if event["delay"] is None else f"after {event['delay']} frames"
        rows.append((f"{event['event']} at {event['frame']}", f"tracked {delay}"))
    return rows


def _trust_rows(trust: dict[str, Any]) -> list[tuple[str, str]]:
    """The headline, see trust.py: names and texts."""
    first, longest, seen = trust["first_right"], trust["longest_silent"], trust["visible"]
    run = f", up to {longest} frames in a row" if longest else ""
    usable, alarms = (
        _figure(trust[name] if seen else None) for name in ("usable_pct", "false_alarm_pct")
    )
    rows = [
        ("usable", f"{usable} % of the {seen} visible frames"),
        ("silently wrong", f"{_figure(trust['silent_pct'] if trust['frames'] else None)} %{run}"),
        ("false alarms", f"{alarms} %"),
        ("first right", _first_right(first, seen)),
    ]
    after = ["never" if frames is None else str(frames) for frames in trust["found_after"]]
    if after:
        rows.append(("found again", f"after {', '.join(after)} frames"))
    return rows


def _region_rows(coverage: dict[str, Any] | None) -> list[tuple[str, str]]:
    """How often 90 % regions hold, see measures.py; nothing where there are none."""
    if coverage is None or coverage["in_region_90_pct"] is None:
        return []
    hidden = coverage["hidden_in_region_90_pct"]
    of_hidden = "" if hidden is None else f", {_figure(hidden)} % of the hidden ones"
    share = _figure(coverage["in_region_90_pct"])
    return [("in their 90 % region", f"{share} % of the joints{of_hidden}")]


def _flag_rows(further: dict[str, Any] | None) -> list[tuple[str, str]]:
    """What joint_ok flags of visible fingertips, see measures.py; nothing where nobody knows."""
    if further is None or "tips_right" not in further:
        return []
    counts = (
        f"{further[f'tips_{kind}_flagged']} of {further[f'tips_{kind}']} {kind}"
        for kind in ("wrong", "right")
    )
    return [("joint_ok flags", f"{', '.join(counts)} fingertips")]


def _first_right(first: int | None, seen: int) -> str:
    if not seen:
        return "-"
    return "never" if first is None else f"in frame {first}"


def _mean(values: np.ndarray) -> float | None:
    values = values[~np.isnan(values)]
    return float(values.mean()) if values.size else None


def _share_pct(part: np.ndarray, whole: np.ndarray) -> float:
    return 100.0 * float(part.sum()) / max(1.0, float(whole.sum()))


def _in_sight(error: np.ndarray, truth: Truth) -> np.ndarray:
    """The (T, 21) errors with NaN for joints that are out of sight."""
    return error if truth.joint_visible is None else np.where(truth.joint_visible, error, np.nan)


def _precision_recall(
    flagged: np.ndarray, positive: np.ndarray
) -> tuple[float | None, float | None]:
    """Over bool arrays (n,); None where nothing was flagged or nothing was positive."""
    hits = float((flagged & positive).sum())
    return (
        hits / float(flagged.sum()) if flagged.any() else None,
        hits / float(positive.sum()) if positive.any() else None,
    )


def _near_change(present: np.ndarray, tolerance: int) -> np.ndarray:
    """(T,) bool: at most `tolerance` frames lie between the frame and a change of `present`."""
    near = np.zeros(len(present), bool)
    for change in np.flatnonzero(np.diff(present)) + 1:  # first frame of the new value
        near[max(0, change - tolerance) : change + tolerance] = True
    return near


def _delay(tracking: np.ndarray, present: np.ndarray, frame: int, hold: int) -> int | None:
    gone = np.flatnonzero(~present[frame:])
    end = frame + int(gone[0]) if len(gone) else len(present)
    return next((t - frame for t in range(frame, end) if tracking[t : t + hold].all()), None)


def _events(truth: Truth) -> list[tuple[str, int]]:
    """(event, frame) in the order of time; see the head of this module."""
    visible, in_space = truth.visible, truth.in_space
    fraction = truth.visible_fraction
    fraction = visible.astype(float) if fraction is None else np.asarray(fraction, float)
    in_full = fraction >= _BACK_IN_VIEW
    found: list[tuple[str, int]] = []
    covered = gone = False
    for t in range(len(visible)):
        returned = t > 0 and visible[t] and not visible[t - 1]
        if returned:
            found.append(("return", t))
            if in_full[t:].any():
                found.append(("entered", t + int(in_full[t:].argmax())))
        if t > 0 and in_space[t] and not in_space[t - 1]:
            found.append(("in_space", t))
        gone |= not visible[t]
        covered |= fraction[t] < _COVERED
        if covered and in_full[t]:
            if not gone:
                found.append(("unoccluded", t))
            covered = gone = False
    return sorted(found, key=lambda event: event[1])


def _figure(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
