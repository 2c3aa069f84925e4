#!/usr/bin/env python3
"""Makes docs/figures.json, and from it the marked tables of README.md and docs/*.md.

    python docs/make_figures.py                   measure what is at hand, write both
    python docs/make_figures.py --kinect2 KINECT2.npz --stills STILLS.npz --sets DATA
    python docs/make_figures.py --tables          write the tables only
    python docs/make_figures.py --strangers       track the public test set, append to history.md
    python docs/make_figures.py --in-turn FILE    take the times, measure nothing
    python docs/make_figures.py --real NAME=FILE,FILE  take what measure.py measured, a file a seed

The first measures the sample, tests/data/guards and tests/data/empty; with the recordings that
tests/data/kinect2/make_extract.py and tests/data/stills/make_extract.py make, the labelled images;
with --sets, the folders crowd, grasps and mesh-hand in DATA. What is not given keeps its figures
and their commit. The public test set, tests/data/strangers, is tracked by --strangers only, once
at the end of a piece of work: its rows are read from docs/lab/history.md. --peer-python PYTHON
measures MediaPipe, too, wherever there is amplitude. The README's times are of one run, in which
all programs take turns: `toftrack benchmark alternating --peer-python PYTHON --json FILE`.
"""

from __future__ import annotations

import argparse
import datetime
import json
import statistics
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs"))
from figure_tables import HISTORY_KEYS, history_row, history_rows, kept_keys, with_tables  # noqa: E402

DATA = ROOT / "tests" / "data"
FIGURES = ROOT / "docs" / "figures.json"
HISTORY = ROOT / "docs" / "lab" / "history.md"
SEEDS = "0,1,2"
SETS = {"crowd": "told", "grasps": "told", "mesh-hand": "auto"}
"""What toftrack is developed on, and whether the side is told: mesh-hand does not know it."""
BARE = 12
"""So many of the strangers, the first ones, show bare hands to a camera before them."""


def main(arguments: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    if options.strangers:
        _append_strangers(options)
    figures = json.loads(FIGURES.read_text(encoding="utf-8")) if FIGURES.exists() else {"rows": {}}
    if options.real is not None:
        figures["rows"] |= _real(*options.real.split("=", 1))
    elif options.in_turn is not None:
        figures["rows"] |= _in_turn(options.in_turn)
    elif not options.tables and not options.strangers:
        figures["rows"] |= _measured(options)
    figures["rows"] = {
        name: row for name, row in figures["rows"].items() if not name.startswith("strangers")
    } | history_rows(HISTORY.read_text(encoding="utf-8"))
    figures["rows"] = dict(sorted(figures["rows"].items()))
    FIGURES.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        before = path.read_text(encoding="utf-8")
        after = with_tables(before, figures)
        if after != before:
            path.write_text(after, encoding="utf-8")
            print(f"written: {path.relative_to(ROOT)}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--strangers", action="store_true", help="track the public test set")
    what.add_argument("--tables", action="store_true", help="measure nothing")
    what.add_argument("--in-turn", type=Path, metavar="FILE", help="of benchmark alternating")
    about = "at hand, away or rooms, and the JSON of tests/data/real/measure.py"
    what.add_argument("--real", metavar="NAME=FILE,FILE", help=about)
    parser.add_argument("--kinect2", type=Path, metavar="FILE", help="the real recording")
    parser.add_argument("--stills", type=Path, metavar="FILE", help="the real stills")
    parser.add_argument("--sets", type=Path, metavar="DATA", help="the sets to develop on")
    parser.add_argument("--peer-python", type=Path, metavar="PYTHON", help="MediaPipe's")
    parser.add_argument("--workers", default="1", metavar="N", help="processes (1)")
    return parser


def _measured(options: argparse.Namespace) -> dict[str, Any]:
    """The rows of all that is at hand, by name."""
    rows: dict[str, Any] = {}
    sample = [ROOT / "toftrack" / "data" / "sample.npz"]
    rows |= _rows("sample", sample, "auto", options, peer=True)
    rows |= _rows("guards", [DATA / "guards"], "told", options)
    rows |= _rows("empty", [DATA / "empty"], "auto", options)
    for name in ("kinect2", "stills"):
        file = getattr(options, name)
        if file is not None:
            labels = DATA / name / "labels.json"
            found = _benchmark([file, "--labels", labels], "told", options)
            images = next(iter(found["images"].values()))
            kept = {key: images[key] for key in kept_keys("images") if images.get(key) is not None}
            rows[name] = kept | _about(found)
    if options.sets is not None:
        for name, side in SETS.items():
            rows |= _rows(name, [options.sets / name], side, options, peer=True)
    return rows


def _real(name: str, file: str) -> dict[str, Any]:
    """The row of real recordings: means over those with truth, weighted by their frames; of the
    others how many frames are flagged. `file` has what tests/data/real/measure.py --json wrote, a
    file a seed, with commas between."""
    several = [json.loads(Path(one).read_text(encoding="utf-8")) for one in file.split(",")]
    found = [one for several_rows in several for one in several_rows["rows"].values()]
    true = [row for row in found if "usable_pct" in row]
    row = _about(several[0]["about"] | {"seeds": [one["about"]["seed"] for one in several]})
    if not true:  # rooms without a hand
        lost = [
            one.get("flagged", sum(shown.endswith(": lost") for shown in one.get("called", ())))
            for one in found
        ]
        row["frames"] = sum(one.get("frames", one.get("images")) for one in found)
        row["called_pct"] = round(100 * (1 - sum(lost) / row["frames"]), 2)
        return {name: row}
    row["frames"] = sum(one["frames"] for one in true)
    for key in ("usable_pct", "silent_pct", "tips_40_pct", "tips_wrong_ok_pct"):
        said = [one["frames"] - one["flagged"] * key.startswith("tips") for one in true]
        row[key] = round(
            sum(n * one[key] for n, one in zip(said, true, strict=True)) / sum(said), 2
        )
    things = [one for one in found if "usable_pct" not in one and "flagged" in one]
    if things:
        flagged, frames = (sum(one[key] for one in things) for key in ("flagged", "frames"))
        row["thing_flagged_pct"] = round(100 * flagged / frames, 1)
    return {name: row}


def _in_turn(file: Path) -> dict[str, Any]:
    """The rows of times from what `toftrack benchmark alternating --json` wrote."""
    from toftrack import __version__
    from toftrack.evaluation.results import commit

    found = json.loads(file.read_text(encoding="utf-8"))
    machine = found["machine"]
    about = {
        "commit": commit(),
        "seeds": [0],
        "side": "told",
        "machine": f"{machine['processor']}, {machine['cores']} cores",
        "versions": f"toftrack {__version__}, torch {machine['torch']}",
    }
    names = {"one hand, side given": "in turn", "MediaPipe, one hand": "in turn, mediapipe"}
    medians = {
        times["name"]: statistics.median(statistics.median(one) for one in times["rounds"])
        for times in found["frames"]
    }
    return {row: about | {"median_ms": medians[name]} for name, row in names.items()}


def _rows(
    name: str, paths: Sequence[Path], side: str, options: argparse.Namespace, peer: bool = False
) -> dict[str, Any]:
    """The row of a set, and that of MediaPipe on it."""
    found = _benchmark(paths, side, options, peer)
    rows = {name: _kept(found["total"]) | _about(found)}
    if "peer" in found:
        about = _about(found) | {"seeds": [0], "versions": found["peer"]["mediapipe"]}
        rows[f"{name}, mediapipe"] = _kept(found["peer"]["total"]) | about
    return rows


def _kept(total: dict[str, Any]) -> dict[str, Any]:
    return {key: total[key] for key in HISTORY_KEYS if total.get(key) is not None}


def _about(found: dict[str, Any]) -> dict[str, Any]:
    """Where a row was made."""
    return {
        "commit": found["commit"],
        "seeds": found["seeds"],
        "side": found["side"],
        "machine": f"{found['machine']['processor']}, {found['machine']['cores']} cores",
        "versions": f"toftrack {found['toftrack']}, torch {found['torch']}",
    }


def _benchmark(
    what: Sequence[str | Path], side: str, options: argparse.Namespace, peer: bool = False
) -> dict[str, Any]:
    """What `toftrack benchmark accuracy` writes."""
    from toftrack.programs.benchmark import main as benchmark

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "accuracy.json")
        given = [*what, "--side", side, "--seeds", SEEDS, "--workers", options.workers]
        if peer and options.peer_python is not None:
            given += ["--peer", "mediapipe", "--peer-python", options.peer_python]
        benchmark(["accuracy", *(str(word) for word in (*given, "--json", file))])
        found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return found


def _append_strangers(options: argparse.Namespace) -> None:
    """Track the public test set; rows for bare hands and for the rest go into history.md."""
    from toftrack.evaluation.rows import totals

    found = _benchmark([DATA / "strangers"], "told", options, peer=True)
    about = _about(found) | {"date": datetime.date.today().isoformat()}
    methods = {"toftrack": found["rows"]}
    if "peer" in found:
        methods["mediapipe"] = found["peer"]["rows"]
    lines = []
    for method, rows in methods.items():
        names = sorted({row["recording"] for row in rows})
        for kind, some in (("bare", names[:BARE]), ("others", names[BARE:])):
            mine = [row for row in rows if row["recording"] in some]
            seeds = sorted({row["seed"] for row in mine})
            total = totals(mine) | about | {"seeds": seeds, "method": method, "hands": kind}
            lines.append(history_row(total))
    text = HISTORY.read_text(encoding="utf-8").rstrip("\n")
    HISTORY.write_text("\n".join([text, *lines]) + "\n", encoding="utf-8")
    print(f"{len(lines)} rows appended to {HISTORY.relative_to(ROOT)}")


if __name__ == "__main__":
    sys.exit(main())
