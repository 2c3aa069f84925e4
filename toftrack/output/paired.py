"""Two measurements of the same recordings with the same seeds, compared pair by pair.

A recording's difference is the mean over its seeds of (here - there); the difference of all is the
mean over recordings, its 90 % interval from resampling the recordings. What all recordings have in
common, hard or easy, drops out, so that far smaller changes are seen than between two totals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from toftrack.output.accuracy import MEANS, Row
from toftrack.output.image_labels import IMAGE_MEANS
from toftrack.output.trust import interval

COMPARED = ("longest_silent", "never_right", "first_right")
"""What is compared beside the means."""


def compared(here: Sequence[Row], there: Sequence[Row]) -> dict[str, Any]:
    """The differences of rows by recording and seed, JSON-able.

    Returns:
        pairs: recordings with a seed that both have.
        only_here, only_there: what is left out, in words, "crowd/01_back_turn, seed 2".
        differences: of each figure that both have, its means over the pairs `here` and `there`, and
            the `mean` difference (here - there) with its 90 % interval, `low` to `high`, over
            `recordings`.
    """
    mine, theirs = (
        {(row["recording"], row["seed"]): row for row in rows} for rows in (here, there)
    )
    common = [pair for pair in mine if pair in theirs]
    differences = {}
    for key in (*MEANS, *COMPARED, *IMAGE_MEANS):
        both: dict[str, list[tuple[float, float]]] = {}
        for pair in common:
            values = mine[pair].get(key), theirs[pair].get(key)
            if values[0] is not None and values[1] is not None:
                both.setdefault(pair[0], []).append((float(values[0]), float(values[1])))
        if both:
            means = np.array([np.mean(values, axis=0) for values in both.values()])
            found = dict(zip(("here", "there"), means.mean(0).tolist(), strict=True))
            found |= asdict(interval((means[:, 0] - means[:, 1]).tolist()))
            differences[key] = {name: round(value, 4) for name, value in found.items()}
            differences[key]["recordings"] = len(means)
    return {
        "pairs": len(common),
        "only_here": _named(mine, theirs),
        "only_there": _named(theirs, mine),
        "differences": differences,
    }


def _named(these: dict[Any, Row], others: dict[Any, Row]) -> list[str]:
    return [f"{name}, seed {seed}" for name, seed in these if (name, seed) not in others]


def rows_of(content: Any) -> list[Row]:
    """The rows of a measurement's JSON; ValueError, a few words, where it is none."""
    rows = content.get("rows") if isinstance(content, dict) else None
    if not isinstance(rows, list) or not rows:
        raise ValueError("it has no 'rows'")
    for row in rows:
        if not isinstance(row, dict) or not isinstance(row.get("recording"), str):
            raise ValueError("its 'rows' do not name recordings")
        if type(row.get("seed")) is not int:
            raise ValueError(f"its row of '{row['recording']}' has no seed")
        for key in (*MEANS, *COMPARED, *IMAGE_MEANS):
            value = row.get(key)
            number = isinstance(value, int | float) and math.isfinite(value)
            if value is not None and not number:
                raise ValueError(f"'{key}' of '{row['recording']}' is no number")
    return rows
