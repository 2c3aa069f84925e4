"""Accuracy as a picture: what the visible frames of each recording are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from toftrack.views.figures.chart import (
    BLUE,
    GREEN,
    GREY,
    SKY,
    VERMILLION,
    box_mark,
    canvas,
    legend,
    ticks,
    titled,
    write,
)

_PARTS = (
    ("usable", "usable_pct", GREEN),
    ("partly", "partly_pct", SKY),
    ("false alarm", "false_alarm_pct", BLUE),
    ("silently wrong", "silent_pct", VERMILLION),
)
_LINE = 26
_LEFT, _BAR = 330, 560


def accuracy_figure(each: Mapping[str, Mapping[str, Any]], total: Mapping[str, Any]) -> np.ndarray:
    """A bar a recording and one for their mean, BGR.

    each: figures of recordings, see output/accuracy.py.  total: theirs, with `usable_90`, which is
    drawn as a line across its end.
    """
    rows = {**each, "mean of the recordings": total}
    height = 76 + _LINE * len(rows)
    picture = canvas(height, _LEFT + _BAR + 150)
    entries = [(name, colour) for name, _, colour in _PARTS] + [("flagged, rightly", (235,) * 3)]
    legend(picture, entries, (_LEFT, 20), box_mark)
    for tick in ticks(0.0, 100.0, most=11):
        u = _place(tick)
        cv2.line(picture, (u, 32), (u, height - 34), (225, 225, 225), 1)
        write(picture, f"{tick:g}", (u, height - 14), align="middle", size=0.45)
    write(picture, "% of the visible frames", (_LEFT + _BAR + 24, height - 14), size=0.4)
    for number, (name, row) in enumerate(rows.items()):
        top = 38 + _LINE * number
        write(picture, name, (_LEFT - 10, top + 15), align="right", size=0.45)
        begin = 0.0
        cv2.rectangle(picture, (_LEFT, top), (_LEFT + _BAR, top + 18), (235,) * 3, -1)
        for _, key, colour in _PARTS:
            end = min(begin + (row.get(key) or 0.0), 100.0)
            cv2.rectangle(picture, (_place(begin), top), (_place(end), top + 18), colour, -1)
            begin = end
        cv2.rectangle(picture, (_LEFT, top), (_LEFT + _BAR, top + 18), GREY, 1)
        error = row.get("mean_all_mm")
        if error is not None:
            write(picture, f"{error:.1f} mm", (_LEFT + _BAR + 14, top + 15), size=0.45)
    if ends := total.get("usable_90"):
        middle = 38 + _LINE * (len(rows) - 1) + 9
        low, high = (_place(end) for end in ends)
        cv2.line(picture, (low, middle), (high, middle), (0, 0, 0), 2)
        for u in (low, high):
            cv2.line(picture, (u, middle - 5), (u, middle + 5), (0, 0, 0), 2)
    several = "s" if total["seeds"] > 1 else ""
    note = (
        f"{total['recordings']} recordings, {total['seeds']} seed{several}. Beside the bars "
        "the mean joint error over all visible frames, across the last one the 90 % interval of "
        "usable. Silently wrong ones are % of all frames."
    )
    return titled(picture, "What the frames are", note)


def _place(percent: float) -> int:
    return round(_LEFT + _BAR * percent / 100)
