"""What a measurement of accuracy writes, as JSON, text and Markdown, where it was made, and two of
them pair by pair; rows.py says what the figures are.

A recording's difference is the mean over its seeds of (here - there); the difference of all is the
mean over recordings, its 90 % interval from resampling the recordings. What all recordings have in
common, hard or easy, drops out, so that far smaller changes are seen than between two totals.
"""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

import toftrack
from toftrack.errors import reported_errors
from toftrack.evaluation.figures import COMPARED, Columns, columns
from toftrack.evaluation.rows import Row, by_recording, groups, image_totals, interval_name, totals
from toftrack.evaluation.statistics import interval, text_of
from toftrack.files.json_text import read_json
from toftrack.files.safe_files import check_replaceable, write_whole

FORMAT = "toftrack accuracy 1"
Table = list[list[str]]
"""Rows of cells, the heads first; the first column is text."""
FEWEST_FOR_A_STAR = 5
"""Recordings; fewer, drawn again, are too much alike for an interval to be believed."""


def circumstances() -> dict[str, Any]:
    """Commit (None where there is no repository), versions and machine; JSON-able."""
    return {
        "format": FORMAT,
        "toftrack": version("toftrack"),
        "commit": commit(),
        "torch": torch.__version__,
        "python": platform.python_version(),
        "machine": {"processor": processor(), "cores": os.cpu_count()},
    }


def processor() -> str:
    """The processor's name, as well as it is known here."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def commit() -> str | None:
    """The commit of the checkout that this package is in, with a + where files differ from it."""
    root = Path(toftrack.__file__).parents[1]
    if not (root / ".git").exists():
        return None
    try:
        said = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty=+", "--exclude=*"],
            capture_output=True,
            text=True,
            timeout=20,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return said.stdout.strip() or None


def result_of(rows: Sequence[Row]) -> dict[str, Any]:
    """Totals, recordings, labelled images, groups and the rows themselves; JSON-able."""
    rows = sorted(rows, key=lambda row: (row["recording"], row["seed"]))
    true = [row for row in rows if "kind" not in row]
    images: dict[str, Any] = {}
    for name in dict.fromkeys(row["recording"].partition("#")[0] for row in rows if "kind" in row):
        mine = [row for row in rows if "kind" in row and row["recording"].startswith(f"{name}#")]
        images[name] = image_totals(mine)
        shown = {row["shown"] for row in mine if "shown" in row}
        if shown:
            images[name]["by"] = {
                of: image_totals([row for row in mine if row["shown"] == of])
                for of in sorted(shown, key=lambda of: (int(of) if of.isdecimal() else 0, of))
            }
    return {
        "total": totals(true) if true else None,
        "each": by_recording(true),
        "images": images,
        "groups": groups(true),
        "rows": rows,
    }


def read_rows(path: Path) -> list[Row]:
    """The rows of an earlier measurement; ToftrackError where the file is none."""
    what = f"--compare '{path}' is no file that toftrack benchmark accuracy --json wrote"
    damaged = OSError, ValueError, KeyError, TypeError
    with reported_errors(what, "give such a file", *damaged):
        content = read_json(path)
        if not isinstance(content, dict) or not content.get("rows"):
            raise ValueError("it has no 'rows'")
        rows: list[Row] = content["rows"]
        for row in rows:
            name, seed = row["recording"], row["seed"]
            figures = [row[key] for key in COMPARED if row.get(key) is not None]
            numbers = all(isinstance(one, int | float) and math.isfinite(one) for one in figures)
            if not (numbers and isinstance(name, str) and type(seed) is int):
                raise ValueError(f"its row of {name!r} is damaged")
    return rows


def checked_targets(*paths: Path | None) -> None:
    """Whether files can be written there; before the work, not after it."""
    for path in filter(None, paths):
        with reported_errors(f"'{path}' cannot be written", "give another name"):
            check_replaceable(path)
            if not os.access(path.absolute().parent, os.W_OK):
                raise OSError("its folder does not exist, or is read-only")
            if path.exists() and not os.access(path, os.W_OK):
                raise OSError("it is read-only")


def write_text(path: Path, text: str) -> None:
    """A whole text file, or the old one and a ToftrackError."""
    with reported_errors(f"the file '{path}' cannot be written", "choose another place"):
        write_whole(path, text)


def json_text(result: dict[str, Any]) -> str:
    """With a line a row."""
    rows = ",\n".join(json.dumps(row, allow_nan=False) for row in result["rows"])
    rest = {name: value for name, value in result.items() if name != "rows"}
    head = json.dumps(rest, indent=1, allow_nan=False).removesuffix("\n}")
    return f'{head},\n "rows": [\n{rows}\n ]\n}}\n'


def compared(here: Sequence[Row], there: Sequence[Row]) -> dict[str, Any]:
    """The differences of rows by recording and seed, JSON-able.

    pairs: recordings with a seed that both have.  only_here, only_there: what is left out, in
    words, "crowd/01_back_turn, seed 2".  differences: of each figure that both have, its means over
    the pairs, `here` and `there`, and the `mean` difference (here - there) with its 90 % interval,
    `low` to `high`, over `recordings`.
    """
    mine, theirs = ({(row["recording"], row["seed"]): row for row in of} for of in (here, there))
    common = [pair for pair in mine if pair in theirs]
    differences = {}
    for key in COMPARED:
        both: dict[str, list[tuple[float, float]]] = {}
        for pair in common:
            values = mine[pair].get(key), theirs[pair].get(key)
            if values[0] is not None and values[1] is not None:
                both.setdefault(pair[0], []).append((float(values[0]), float(values[1])))
        if both:
            means = np.array([np.mean(values, axis=0) for values in both.values()])
            found = dict(zip(("here", "there"), means.mean(0).tolist(), strict=True))
            found |= interval((means[:, 0] - means[:, 1]).tolist())._asdict()
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


def accuracy_tables(result: Mapping[str, Any]) -> dict[str, Table]:
    """By their titles: recordings, labelled images, groups, differences."""
    tables: dict[str, Table] = {}
    total = result.get("total")
    if total:
        all_of = {**total, "first_right": total["median_first_right"]}
        table = table_of(columns("each"), {**result["each"], "total": all_of}, "recording")
        shares = [(key, digits) for title, key, digits in columns("each") if title in table[0]]
        table.append(["90 % interval", *(_interval(total, *share) for share in shares)])
        tables["recordings"] = table
    shown: dict[str, Any] = {}
    for name, figures in result.get("images", {}).items():
        shown[name] = figures
        shown |= {f"  {of}": row for of, row in figures.get("by", {}).items()}
    if shown:
        tables["labelled images"] = table_of(columns("images"), shown, "labels")
    for kind, found in result.get("groups", {}).items():
        tables[kind] = table_of(columns("groups"), found, kind)
    if comparison := result.get("comparison"):
        tables[f"differences to {comparison['with']}"] = difference_table(comparison["differences"])
    return tables


def difference_table(differences: Mapping[str, Mapping[str, Any]]) -> Table:
    """Here, there, the difference and its interval; marked where that does not hold 0."""
    table = [["figure", "here", "there", "difference", "90 % interval", "recordings", ""]]
    for key, of in differences.items():
        cells = [f"{of[name]:.2f}" for name in ("here", "there")]
        spread = f"{of['low']:+.2f} to {of['high']:+.2f}" if of["recordings"] > 1 else "-"
        change = [f"{of['mean']:+.2f}", spread]
        table.append([key, *cells, *change, str(of["recordings"]), clear_mark(of)])
    return table


def clear_mark(of: Mapping[str, Any]) -> str:
    """A star for a difference whose interval, over enough recordings, does not hold 0."""
    enough = of["recordings"] >= FEWEST_FOR_A_STAR
    return "*" if enough and (of["low"] > 0 or of["high"] < 0) else ""


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


def table_of(columns: Columns, rows: Mapping[str, Mapping[str, Any]], first: str) -> Table:
    """Rows by name; columns (title, key, digits) that no row has anything for are left out."""
    used = [
        column for column in columns if any(r.get(column[1]) is not None for r in rows.values())
    ]
    table = [[first, *(title for title, _, _ in used)]]
    for name, row in rows.items():
        table.append([name, *(text_of(row.get(key), digits) for _, key, digits in used)])
    return table


def _interval(total: Mapping[str, Any], key: str, digits: int) -> str:
    ends = total.get(interval_name(key)) if total["recordings"] > 1 else None
    return "" if ends is None else f"{text_of(ends[0], digits)}..{text_of(ends[1], digits)}"
