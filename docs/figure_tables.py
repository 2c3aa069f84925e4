"""The tables that docs/make_figures.py writes into README.md and docs/*.md, from docs/figures.json.

A table stands between `<!-- figures: NAME -->` and `<!-- end -->`. Nothing here measures.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from toftrack.evaluation.figures import FIGURES


def kept_keys(table: str) -> tuple[str, ...]:
    """Of a table's figures, what of their totals is kept."""
    kept = [f for f in FIGURES if {table, "history"} <= set(f.shown.split())]
    return tuple(f"median_{f.key}" if f.over == "median" else f.key for f in kept)


NOT_YET = "not measured yet"
HISTORY_KEYS = ("usable_pct", "usable_90", *kept_keys("each")[1:])
"""Of recordings, what is kept; of the first one the interval, too."""
_FACTS = ("date", "commit", "method", "hands", "seeds", "side", "machine", "versions")
HISTORY_HEAD = (*_FACTS, *HISTORY_KEYS)
"""Columns of the table in docs/lab/history.md."""
_MARKED = re.compile(r"(<!-- figures: ([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
Rows = Mapping[str, Mapping[str, Any]]


def with_tables(text: str, figures: Mapping[str, Any]) -> str:
    """A page with its marked tables made anew; KeyError for a table that there is none of."""

    def table(found: re.Match[str]) -> str:
        return found[1] + "\n".join(TABLES[found[2]](figures["rows"])) + "\n" + found[3]

    return _MARKED.sub(table, text)


def history_row(row: Mapping[str, Any]) -> str:
    """A line of the table in docs/lab/history.md."""
    return "| " + " | ".join(_cell(row.get(key)) for key in HISTORY_HEAD) + " |"


def history_rows(text: str) -> dict[str, dict[str, Any]]:
    """The latest rows of docs/lab/history.md, "strangers, bare" and so on; none where there is no
    table yet, or it has no rows."""
    rows: dict[str, dict[str, Any]] = {}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split(" | ")]
        if len(cells) != len(HISTORY_HEAD) or not re.fullmatch(r"\d{4}-\d\d-\d\d", cells[0]):
            continue
        values = {key: _value(key, cell) for key, cell in zip(HISTORY_HEAD, cells, strict=True)}
        row = {key: value for key, value in values.items() if value is not None}
        method, hands = row.pop("method"), row.pop("hands")
        name = f"strangers, {hands}" + ("" if method == "toftrack" else f", {method}")
        rows[name] = row
    return rows


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, list | tuple):
        return " ".join(f"{one:g}" for one in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _value(key: str, cell: str) -> Any:
    if cell == "-":
        return None
    if key == "seeds":
        return [int(part) for part in cell.split()]
    if key == "usable_90":
        return [float(part) for part in cell.split()]
    return cell if key in _FACTS else float(cell)


def _show(rows: Rows, name: str, key: str, unit: str, digits: int = 0) -> str:
    row = rows.get(name)
    if row is None:
        return NOT_YET
    value = row.get(key)
    return "-" if value is None else f"{value:.{digits}f} {unit}".rstrip()


def _readme(rows: Rows) -> list[str]:
    def both(name: str, *how: Any) -> str:
        peer = f"{name}, mediapipe"
        return f"{_show(rows, name, *how)} | {_show(rows, peer, *how)}"

    def one(name: str, *how: Any) -> str:
        return f"{_show(rows, name, *how)} | "

    bare, others = "strangers, bare", "strangers, others"
    return [
        "| | toftrack | MediaPipe Hands |",
        "| --- | --- | --- |",
        "| **real, held out until the end: Senz3D on the head**, 1015 frames of three motions of"
        " one hand: usable |"
        f" {one('away', 'usable_pct', '%')} |",
        f"| ... silently wrong | {one('away', 'silent_pct', '%', 1)} |",
        "| ... all visible fingertips within 40 mm, of the frames not flagged |"
        f" {one('away', 'tips_40_pct', '%')} |",
        "| ... a visible fingertip farther off, neither it nor the frame flagged |"
        f" {one('away', 'tips_wrong_ok_pct', '%', 1)} |",
        "| **real, no setting chosen on it: Kinect V2**, 25 frames: all visible fingertips within"
        f" 40 mm | {one('kinect2, kept back', 'tips_40_pct', '%')} |",
        "| ... a fingertip farther off, not flagged |"
        f" {one('kinect2, kept back', 'wrong_pct', '%')} |",
        "| **real, settings chosen on it**: 27 other frames of the Kinect: all visible"
        f" fingertips within 40 mm | {one('kinect2', 'tips_40_pct', '%')} |",
        "| ... 165 single images of eleven gestures, Senz3D: hand found |"
        f" {one('stills', 'found_pct', '%')} |",
        f"| ... and its gesture named correctly | {one('stills', 'named_pct', '%')} |",
        "| ... 1151 frames of three other motions, Senz3D on the head: usable |"
        f" {one('at hand', 'usable_pct', '%')} |",
        "| ... a hand with an object, SR300 on the head, 84 frames, nearly all with a wrong pose:"
        f" flagged | {one('at hand', 'thing_flagged_pct', '%')} |",
        "| **12 rendered persons**, no setting chosen on them: usable |"
        f" {both(bare, 'usable_pct', '%')} |",
        f"| ... silently wrong | {both(bare, 'silent_pct', '%', 1)} |",
        "| ... mean joint error, all frames with a visible hand |"
        f" {both(bare, 'mean_all_mm', 'mm', 1)} |",
        f"| **4 more, of whom three hold objects**: usable | {both(others, 'usable_pct', '%')} |",
        "| **rendered rooms, and persons who raise no hand**: reported as a hand |"
        f" {one('empty', 'silent_pct', '%', 1)} |",
        "| **17 real rooms without a hand**, 1175 images (292 used for one choice):"
        " reported as a hand |"
        f" {one('rooms', 'called_pct', '%', 1)} |",
        "| **time per frame**, packaged sample, programs in turn; MediaPipe looks for one hand |"
        f" {both('in turn', 'median_ms', 'ms', 1)} |",
    ]


_SETS = {
    "strangers, bare": "strangers, 12 with bare hands",
    "strangers, others": "strangers, 4 that hold objects or are seen from the head",
    "crowd": "crowd (settings chosen on it)",
    "grasps": "grasps",
    "mesh-hand": "mesh-hand (side not given)",
    "guards": "guards",
    "sample": "the packaged sample (side not given)",
}


def _sets(rows: Rows) -> list[str]:
    keys: Sequence[tuple[str, str, int]] = (
        ("usable %", "usable_pct", 1),
        ("partly %", "partly_pct", 1),
        ("silent %", "silent_pct", 1),
        ("false alarms %", "false_alarm_pct", 1),
        ("mean all mm", "mean_all_mm", 1),
        ("usable: joints mm", "usable_mean_mm", 1),
        ("usable: tips mm", "usable_tip_mm", 1),
    )
    lines = [
        "| recordings | method | " + " | ".join(title for title, _, _ in keys) + " | commit |",
        "| --- | --- |" + " --- |" * (len(keys) + 1),
    ]
    for name, title in _SETS.items():
        for method, key in (("toftrack", name), ("MediaPipe", f"{name}, mediapipe")):
            if key in rows:
                cells = [_show(rows, key, figure, "", digits) for _, figure, digits in keys]
                low_high = rows[key].get("usable_90")
                if low_high:
                    cells[0] += f" ({low_high[0]:.0f} to {low_high[1]:.0f})"
                commit = str(rows[key]["commit"])
                lines.append(f"| {title} | {method} | " + " | ".join([*cells, commit]) + " |")
            elif name.startswith("strangers"):
                lines.append(f"| {title} | {method} | {NOT_YET} |" + " |" * len(keys))
    return lines


def _images(rows: Rows) -> list[str]:
    def line(what: str, name: str, *how: Any) -> str:
        commit = rows[name]["commit"] if name in rows else ""
        return f"| {what} | {_show(rows, name, *how)} | {commit} |"

    def kinect(name: str) -> list[str]:
        return [
            line("... all visible tips within 20 mm", name, "tips_20_pct", "%"),
            line("... within 40 mm", name, "tips_40_pct", "%"),
            line("... a tip farther off, not flagged", name, "wrong_pct", "%"),
        ]

    return [
        "| | toftrack | commit |",
        "| --- | --- | --- |",
        "| Kinect V2, 27 labelled frames; weights and thresholds chosen on them | | |",
        *kinect("kinect2"),
        line("... fingertips, median", "kinect2", "tips_median_mm", "mm", 1),
        line("... fingertips, mean", "kinect2", "tips_mean_mm", "mm", 1),
        "| Kinect V2, 25 other frames of the same recording, held out | | |",
        *kinect("kinect2, kept back"),
        line("stills: found", "stills", "found_pct", "%"),
        line("... named correctly, of all images", "stills", "named_pct", "%"),
        line("... given the name of another gesture", "stills", "wrong_name_pct", "%"),
        line("no raised hand: frames called a hand", "empty", "silent_pct", "%", 1),
    ]


TABLES = {"readme": _readme, "sets": _sets, "images": _images}
"""By name, the lines of each table."""
