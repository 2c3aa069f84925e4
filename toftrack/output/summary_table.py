"""summary.json as text for a terminal."""

from __future__ import annotations

from typing import Any

from toftrack.evaluation.statistics import text_of


def metrics_table(summary: dict[str, Any]) -> str:
    """The content of summary.json as a short table, without final newline."""
    rows = [
        ("frames", _frames_text(summary)),
        ("time a frame", f"{text_of(summary['mean_ms'])} ms ({text_of(summary['fps'])} frames/s)"),
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
            rows.append(("another hand, where is none", f"{text_of(metrics['ghost_pct'])} %"))
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
        f"{text_of(summary['mean_ms'])} ms a frame",
        f"mean score {text_of(summary['mean_score'], 3)}",
    ]
    if metrics := summary.get("metrics"):
        parts.append(f"usable {text_of(metrics['trust']['usable_pct'])} %")
        parts.append(f"joint error {text_of(metrics['mean_mm'])} mm")
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
    return f"{hand['side']}, {text_of(hand['length_mm'], 0)} mm long{fitted}"


def _trust_rows(trust: dict[str, Any]) -> list[tuple[str, str]]:
    """The headline: names and texts."""
    first, longest, seen = trust["first_right"], trust["longest_silent"], trust["visible"]
    silent = text_of(trust["silent_pct"] if trust["frames"] else None)
    usable, alarms = (
        text_of(trust[name] if seen else None) for name in ("usable_pct", "false_alarm_pct")
    )
    right = "never" if first is None else f"in frame {first}"
    rows = [
        ("usable", f"{usable} % of the {seen} visible frames"),
        (
            "silently wrong",
            f"{silent} %" + (f", up to {longest} frames in a row" if longest else ""),
        ),
        ("false alarms", f"{alarms} %"),
        ("first right", right if seen else "-"),
    ]
    after = ["never" if frames is None else str(frames) for frames in trust["found_after"]]
    if after:
        rows.append(("found again", f"after {', '.join(after)} frames"))
    return rows


def _error_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """Errors, regions, flags and when the hand was found again: names and texts."""
    near = metrics["frames_max_below_40mm_pct"] if metrics["frames"] else None
    rows = [
        ("joint error, mean", f"{text_of(metrics['mean_mm'])} mm"),
        ("joint error, median", f"{text_of(metrics['median_mm'])} mm"),
        ("fingertip error", f"{text_of(metrics['fingertip_mm'])} mm"),
        ("wrist-aligned error", f"{text_of(metrics['wrist_aligned_mm'])} mm"),
        ("frames below 40 mm", f"{text_of(near)} %"),
    ]
    if metrics["missing_pct"]:
        rows.append(("without estimate", f"{text_of(metrics['missing_pct'])} %"))
    precision, recall = metrics["lost_precision"], metrics["lost_recall"]
    if precision is not None or recall is not None:
        text = f"precision {text_of(precision, 2)}, recall {text_of(recall, 2)}"
        rows.append(("lost frames", text))
    coverage, further = metrics.get("coverage", {}), metrics["further"]
    if (inside := coverage.get("in_region_90_pct")) is not None:
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
