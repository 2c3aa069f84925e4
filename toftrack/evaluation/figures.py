"""The figures of an evaluation, a line each, in the order of their columns.

Whatever shows, averages or keeps them asks here; trust.py, measures.py and image_labels.py say what
each means.
"""

from __future__ import annotations

from typing import NamedTuple


class Figure(NamedTuple):
    """A figure.  key: in files, and in comparisons.  heading, digits: of its column.

    over: how a total comes from recordings. "mean": their mean, with an interval; "image mean": the
    same of labelled images; "count", "sum", "largest": of all; "median": of all rows; "pooled":
    over all that is counted in all rows.
    shown: in which tables. "each": of recordings; "images": of labelled images; "groups";
    "ablation"; "history": kept in docs/figures.json and docs/lab/history.md.
    """

    key: str
    heading: str
    digits: int
    over: str
    shown: str


FIGURES = (
    Figure("images", "images", 0, "pooled", "images history"),
    Figure("tips_20_pct", "tips < 20 mm %", 1, "image mean", "images history"),
    Figure("tips_40_pct", "< 40 mm %", 1, "image mean", "images history"),
    Figure("wrong_pct", "wrong, unflagged %", 1, "image mean", "images history"),
    Figure("flagged_pct", "lost %", 1, "image mean", "images history"),
    Figure("wrong_no_flag_pct", "wrong, no flag %", 1, "image mean", "images"),
    Figure("frames", "frames", 0, "count", "groups"),
    Figure("visible", "visible", 0, "count", "each"),
    Figure("usable_pct", "usable %", 1, "mean", "each groups ablation history"),
    Figure("partly_pct", "partly %", 1, "mean", "each groups ablation history"),
    Figure("silent_pct", "silent %", 1, "mean", "each groups ablation history"),
    Figure("longest_silent", "longest", 0, "largest", "each history"),
    Figure("false_alarm_pct", "false alarms %", 1, "mean", "each groups ablation history"),
    Figure("never_right", "never right", 1, "sum", "each history"),
    Figure("first_right", "first right", 0, "median", "each history"),
    Figure("mean_all_mm", "mean all mm", 1, "mean", "each ablation history"),
    Figure("mean_mm", "mean mm", 1, "mean", "each groups history"),
    Figure("usable_mean_mm", "usable mean mm", 1, "mean", "each history"),
    Figure("usable_tip_mm", "usable tip mm", 1, "mean", "each ablation history"),
    Figure("tip_mm", "", 1, "mean", ""),
    Figure("swap_pct", "swaps %", 1, "mean", "each ablation history"),
    Figure("jitter_mm", "jitter mm", 2, "mean", "each ablation history"),
    Figure("in_region_90_pct", "90 % regions", 1, "mean", "each history"),
    Figure("tips_wrong", "wrong tips", 0, "pooled", "each images"),
    Figure("wrong_flagged_pct", "flagged %", 1, "pooled", "each images"),
    Figure("tips_right", "right tips", 0, "pooled", "each images"),
    Figure("right_flagged_pct", "right flagged %", 1, "pooled", "each images"),
    Figure("tips_median_mm", "tips median mm", 1, "pooled", "images history"),
    Figure("tips_mean_mm", "tips mean mm", 1, "pooled", "images history"),
    Figure("found_pct", "found %", 1, "image mean", "images history"),
    Figure("named_pct", "named rightly %", 1, "image mean", "images history"),
    Figure("wrong_name_pct", "wrong name %", 1, "image mean", "images history"),
    Figure("gesture_pct", "gestures %", 1, "mean", "each groups history"),
    Figure("side_right_end_pct", "side at end %", 0, "mean", "each"),
    Figure("side_right_soon_pct", "after 10 %", 0, "mean", "each"),
    Figure("side_wrong_certain_pct", "certain, wrong %", 1, "mean", "each"),
    Figure("second_usable_pct", "2nd usable %", 1, "mean", "each"),
    Figure("second_silent_pct", "2nd silent %", 1, "mean", "each"),
    Figure("ghost_pct", "ghosts %", 1, "mean", "each"),
    Figure("median_ms", "ms", 1, "mean", "each ablation history"),
    Figure("p90_ms", "p90 ms", 1, "mean", "each"),
)
Columns = tuple[tuple[str, str, int], ...]


def keys_over(over: str) -> tuple[str, ...]:
    """The figures whose totals come about so."""
    return tuple(figure.key for figure in FIGURES if figure.over == over)


def columns(table: str) -> Columns:
    """A table's columns: heading, key, digits."""
    return tuple((f.heading, f.key, f.digits) for f in FIGURES if table in f.shown.split())


SHARES = ("usable_pct", "partly_pct", "silent_pct", "false_alarm_pct")
MEANS = tuple(dict.fromkeys((*SHARES, "mean_mm", *keys_over("mean"))))
"""Figures whose total is the mean over recordings, with an interval, in the order of the files."""
IMAGE_MEANS = keys_over("image mean")
"""Figures of a labelled image, 0 or 100."""
_OTHERS = (key for how in ("largest", "sum", "median") for key in keys_over(how))
COMPARED = (*MEANS, *_OTHERS, *IMAGE_MEANS)
