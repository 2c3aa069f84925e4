"""What a measurement of accuracy writes, and where it was made."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

import toftrack
from toftrack.errors import ToftrackError, reported_errors
from toftrack.json_text import read_json
from toftrack.output.accuracy import Row, by_recording, groups, image_totals, totals
from toftrack.output.paired import compared, rows_of
from toftrack.safe_files import write_whole

FORMAT = "toftrack accuracy 1"


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
        shown = sorted({row["shown"] for row in mine if "shown" in row}, key=_number)
        if shown:
            images[name]["by"] = {
                of: image_totals([row for row in mine if row["shown"] == of]) for of in shown
            }
    return {
        "total": totals(true) if true else None,
        "each": by_recording(true),
        "images": images,
        "groups": groups(true),
        "rows": rows,
    }


def _number(text: str) -> tuple[int, str]:
    return (int(text) if text.isdecimal() else 0), text


def read_rows(path: Path) -> list[Row]:
    """The rows of an earlier measurement; ToftrackError where the file is none."""
    what = f"'{path}', to compare with, is nothing that toftrack benchmark accuracy --json wrote"
    with reported_errors(what, "give such a file", OSError, ValueError):
        rows = rows_of(read_json(path))
    return rows


def comparison_with(rows: Sequence[Row], others: Sequence[Row], name: str) -> dict[str, Any]:
    """Paired differences, JSON-able; ToftrackError where the two have nothing in common."""
    found = compared(rows, others)
    if not found["pairs"]:
        raise ToftrackError(
            f"'{name}' has none of these recordings with one of these seeds, so that nothing can "
            "be compared; measure the same recordings with the same seeds"
        )
    return {"with": name, **found}


def checked_targets(*paths: Path | None) -> None:
    """Whether files can be written there; before the work, not after it."""
    for path in paths:
        if path is not None and (path.is_dir() or not path.absolute().parent.is_dir()):
            raise ToftrackError(
                f"'{path}' cannot be written: it is a folder, or lies in none that there is; give "
                "another name"
            )


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
