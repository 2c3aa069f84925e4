"""Accuracy as a picture: what the visible frames of each recording are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from toftrack.views.figures import chart

_PARTS = (
    ("usable", "usable_pct", chart.GREEN),
    ("partly", "partly_pct", chart.SKY),
    ("false alarm", "false_alarm_pct", chart.BLUE),
    ("silently wrong", "silent_pct", chart.VERMILLION),
)


def accuracy_figure(each: Mapping[str, Mapping[str, Any]], total: Mapping[str, Any]) -> np.ndarray:
    """A bar a recording and one for their mean, BGR.

    each: figures of recordings, see output/accuracy.py.  total: theirs, with `usable_90`, which is
    drawn as a line across its end.
    """
    rows = {**each, "mean of the recordings": total}
    figure = chart.new_figure(1000, 110 + 26 * len(rows))
    axes = figure.subplots()
    begin = np.zeros(len(rows))
    for name, key, colour in _PARTS:
        share = np.minimum([row.get(key) or 0.0 for row in rows.values()], 100 - begin)
        axes.barh(list(rows), share, left=begin, color=colour, label=name)
        begin += share
    axes.barh(list(rows), 100 - begin, left=begin, color="#ebebeb", label="flagged, rightly")
    if ends := total.get("usable_90"):
        axes.plot(ends, [len(rows) - 1] * 2, "k|-")
    for number, row in enumerate(rows.values()):
        if row.get("mean_all_mm") is not None:
            axes.text(101, number, f"{row['mean_all_mm']:.1f} mm", va="center")
    axes.set(xlim=(0, 100), ylim=(len(rows) - 0.4, -0.6), xlabel="% of the visible frames")
    axes.set_xticks(range(0, 101, 10))
    figure.legend(loc="outside upper center", ncols=5, frameon=False)
    several = "s" if total["seeds"] > 1 else ""
    note = (
        f"{total['recordings']} recordings, {total['seeds']} seed{several}. Beside the bars "
        "the mean joint error over all visible frames, across the last one the 90 % interval of "
        "usable. Silently wrong ones are % of all frames."
    )
    return chart.titled(chart.picture_of(figure), "What the frames are", note)
