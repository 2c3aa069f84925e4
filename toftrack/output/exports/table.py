"""A run as one flat table of comma-separated values."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from toftrack.hand.skeleton import ANGLE_NAMES

_PLAIN = (
    *("state_name", "lost", "dropped", "confidence", "side", "side_probability", "score"),
    *("outside_rad", "gesture", "gesture_probability", "pinch", "pinching"),
)
_POINTS = ("pointing_origin_m", "pointing_direction")


def csv_of(results: Mapping[str, Any]) -> str:
    """The content of a .csv file: a row a frame, or a frame and hand where there are several.

    What is unknown (NaN) is an empty cell. results: of a track.npz.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerows(_rows(results))
    return text.getvalue()


def _rows(results: Mapping[str, Any]) -> Iterator[list[Any]]:
    several = np.ndim(results["lost"]) > 1
    slots = np.shape(results["lost"])[1] if several else 1
    plain = [name for name in _PLAIN if name in results]
    points = [name for name in _POINTS if name in results]
    names = [name.removesuffix("_m") for name in points]
    units = ["_m" if name.endswith("_m") else "" for name in points]
    header = ["index", "timestamp_s", *(["slot"] if several else []), *plain]
    header += [f"{n}_{axis}{u}" for n, u in zip(names, units, strict=True) for axis in "xyz"]
    header += [f"{joint}_{axis}_m" for joint in results["joint_names"] for axis in "xyz"]
    flags = [name for name in ("joint_ok",) if name in results]  # older runs have none
    header += [f"{joint}_ok" for _ in flags for joint in results["joint_names"]]
    header += [f"{angle}_rad" for angle in ANGLE_NAMES]
    yield header
    index = results.get("index", np.arange(len(results["lost"])))
    for row, number in enumerate(index):
        for slot in range(slots):
            here = (row, slot) if several else (row,)
            seconds = f"{results['timestamp_s'][row]:.6f}"
            cells = [number, seconds, *([slot] if several else [])]
            # A frame is dropped for all of its hands.
            cells += [np.asarray(results[name])[here[: np.ndim(results[name])]] for name in plain]
            for name in (*points, "joints_m", *flags):
                cells += results[name][here].ravel().tolist()
            cells += results["state"][here][-len(ANGLE_NAMES) :].tolist()
            yield [_cell(value) for value in cells]


def _cell(value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return str(int(value))
    if isinstance(value, (float, np.floating)):
        return "" if not np.isfinite(value) else f"{value:.6g}"
    return str(value)
