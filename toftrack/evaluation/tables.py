"""Accuracy as text for a terminal and as Markdown: see rows.py for what the figures are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from toftrack.evaluation.rows import interval_name
from toftrack.evaluation.statistics import text_of

_COLUMNS = (
    ("visible", "visible", 0),
    ("usable %", "usable_pct", 1),
    ("partly %", "partly_pct", 1),
    ("silent %", "silent_pct", 1),
    ("longest", "longest_silent", 0),
    ("false alarms %", "false_alarm_pct", 1),
    ("never right", "never_right", 1),
    ("first right", "first_right", 0),
    ("mean mm", "mean_all_mm", 1),
    ("unflagged", "mean_mm", 1),
    ("usable mm", "usable_mean_mm", 1),
    ("tips mm", "usable_tip_mm", 1),
    ("swaps %", "swap_pct", 1),
    ("jitter mm", "jitter_mm", 2),
    ("90 % regions", "in_region_90_pct", 1),
    ("wrong tips", "tips_wrong", 0),
    ("flagged %", "wrong_flagged_pct", 1),
    ("right tips", "tips_right", 0),
    ("right flagged %", "right_flagged_pct", 1),
    ("gestures %", "gesture_pct", 1),
    ("side at end %", "side_right_end_pct", 0),
    ("after 10 %", "side_right_soon_pct", 0),
    ("certain, wrong %", "side_wrong_certain_pct", 1),
    ("2nd usable %", "second_usable_pct", 1),
    ("2nd silent %", "second_silent_pct", 1),
    ("ghosts %", "ghost_pct", 1),
    ("ms", "median_ms", 1),
    ("p90 ms", "p90_ms", 1),
)
"""Columns that no row has anything for are left out."""
_GROUP_COLUMNS = (
    ("frames", "frames", 0),
    ("usable %", "usable_pct", 1),
    ("partly %", "partly_pct", 1),
    ("silent %", "silent_pct", 1),
    ("false alarms %", "false_alarm_pct", 1),
    ("unflagged mm", "mean_mm", 1),
    ("gestures %", "gesture_pct", 1),
)
_IMAGE_COLUMNS = (
    ("images", "images", 0),
    ("tips < 20 mm %", "tips_20_pct", 1),
    ("< 40 mm %", "tips_40_pct", 1),
    ("wrong, unflagged %", "wrong_pct", 1),
    ("lost %", "flagged_pct", 1),
    ("wrong, no flag %", "wrong_no_flag_pct", 1),
    ("wrong tips", "tips_wrong", 0),
    ("flagged %", "wrong_flagged_pct", 1),
    ("right tips", "tips_right", 0),
    ("right flagged %", "right_flagged_pct", 1),
    ("tips median mm", "tips_median_mm", 1),
    ("tips mean mm", "tips_mean_mm", 1),
    ("found %", "found_pct", 1),
    ("named rightly %", "named_pct", 1),
    ("wrong name %", "wrong_name_pct", 1),
)
Table = list[list[str]]
"""Rows of cells, the heads first; the first column is text."""


def accuracy_tables(result: Mapping[str, Any]) -> dict[str, Table]:
    """The tables of a result by their titles: recordings, labelled images, groups, differences."""
    tables: dict[str, Table] = {}
    total = result.get("total")
    if total:
        rows = dict(result["each"])
        all_of = dict(total, first_right=total["median_first_right"])
        table = table_of(_COLUMNS, {**rows, "total": all_of}, "recording")
        heads = [title for title, _, _ in _COLUMNS if title in table[0]]
        keys = {title: (key, digits) for title, key, digits in _COLUMNS}
        table.append(["90 % interval", *(_interval(total, *keys[head]) for head in heads)])
        tables["recordings"] = table
    images = {
        name: figures for name, figures in result.get("images", {}).items() if figures["images"]
    }
    if images:
        shown: dict[str, Any] = {}
        for name, figures in images.items():
            shown[name] = figures
            shown |= {f"  {of}": row for of, row in figures.get("by", {}).items()}
        tables["labelled images"] = table_of(_IMAGE_COLUMNS, shown, "labels")
    for kind, found in result.get("groups", {}).items():
        tables[kind] = table_of(_GROUP_COLUMNS, found, kind)
    if comparison := result.get("comparison"):
        tables[f"differences to {comparison['with']}"] = difference_table(comparison["differences"])
    return tables


def difference_table(differences: Mapping[str, Mapping[str, Any]]) -> Table:
    """Here, there, the difference and its interval; marked where that does not hold 0."""
    table = [["figure", "here", "there", "difference", "90 % interval", "recordings", ""]]
    for key, of in differences.items():
        cells = [f"{of[name]:.2f}" for name in ("here", "there")]
        change = [f"{of['mean']:+.2f}", f"{of['low']:+.2f} to {of['high']:+.2f}"]
        table.append([key, *cells, *change, str(of["recordings"]), clear_mark(of)])
    return table


def clear_mark(of: Mapping[str, Any]) -> str:
    """A star for a difference whose interval, over several recordings, does not hold 0."""
    return "*" if of["recordings"] > 1 and (of["low"] > 0 or of["high"] < 0) else ""


def plain(table: Table) -> str:
    """Columns that line up, without final newline."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = []
    for row in table:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def markdown(table: Table) -> str:
    """The same as a table of Markdown."""
    rule = ["---"] + ["---:"] * (len(table[0]) - 1)
    return "\n".join(f"| {' | '.join(row)} |" for row in [table[0], rule, *table[1:]])


def table_of(
    columns: Sequence[tuple[str, str, int]], rows: Mapping[str, Mapping[str, Any]], first: str
) -> Table:
    """Rows by name; columns (title, key, digits) that no row has anything for are left out."""
    used = [
        column for column in columns if any(r.get(column[1]) is not None for r in rows.values())
    ]
    table = [[first, *(title for title, _, _ in used)]]
    for name, row in rows.items():
        table.append([name, *(text_of(row.get(key), digits) for _, key, digits in used)])
    return table


def _interval(total: Mapping[str, Any], key: str, digits: int) -> str:
    ends = total.get(interval_name(key))
    return "" if ends is None else f"{text_of(ends[0], digits)}..{text_of(ends[1], digits)}"
