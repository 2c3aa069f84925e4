"""What each part of the tracker brings: `toftrack benchmark ablation FOLDER...`.

Tracks recordings with truth as the default does, and again with one part changed or left out, with
the same seeds; differences are paired by recording and seed, with 90 % intervals over recordings.
A * marks intervals that do not hold 0.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any, NamedTuple

from toftrack.evaluation.accuracy import divided
from toftrack.evaluation.results import (
    Table,
    checked_targets,
    circumstances,
    clear_mark,
    compared,
    json_text,
    markdown,
    plain,
    result_of,
    write_text,
)
from toftrack.evaluation.rows import Row
from toftrack.evaluation.runs import jobs, run_jobs, sources


class Variant(NamedTuple):
    """The default with something changed: overrides, and whether the side is given."""

    about: str
    overrides: tuple[str, ...] = ()
    side: str = "told"


DEFAULT = "default"
_STILL = tuple(
    f"filter.spread.{name}=0" for name in ("translation_m", "depth_m", "rotation_rad", "latent")
)
VARIANTS: dict[str, Variant] = {
    DEFAULT: Variant("side given, one hand"),
    "few-particles": Variant("20 particles", ("filter.particles=20",)),
    "no-filter": Variant(
        "no filter: prediction and refinement",
        ("filter.passes=1", "filter.speed_gain=0", *_STILL),
    ),
    "no-refinement": Variant("no refinement", ("refine=none",)),
    "no-keypoints": Variant(
        "no keypoints, neither in the refinement nor in the posterior",
        ("posterior.keypoints=0", "detector.keypoint_weight=0"),
    ),
    "side-found": Variant("handedness detected", (), "auto"),
    "two-hands": Variant("two hands", ("hands=2",)),
}
_SHOWN = (
    ("usable_pct", "usable %"),
    ("partly_pct", "partly %"),
    ("silent_pct", "silent %"),
    ("false_alarm_pct", "false alarms %"),
    ("mean_all_mm", "mean mm"),
    ("usable_tip_mm", "usable tips mm"),
    ("swap_pct", "swaps %"),
    ("jitter_mm", "jitter mm"),
    ("median_ms", "ms"),
)


def measure(options: argparse.Namespace, command: str) -> None:
    """Track with each variant, measure and report; an interruption reports the variants that are
    done before it is passed on. Raises ToftrackError: something that was given cannot be used."""
    names = [DEFAULT, *(name for name in options.variants if name != DEFAULT)]
    paths, overrides = divided(options.what)
    checked_targets(options.json, options.markdown)
    found = sources(paths)
    about = circumstances() | {"command": command, "seeds": options.seeds, "overrides": overrides}
    done: dict[str, list[Row]] = {}
    try:
        for number, name in enumerate(names, 1):
            variant = VARIANTS[name]
            chosen = [*overrides, *variant.overrides]
            todo = jobs(found, options.seeds, variant.side, chosen)
            words = f"{name} ({number} of {len(names)})"
            done[name] = [row for rows in run_jobs(todo, options.workers, words) for row in rows]
            _write(about, done, options)
    except KeyboardInterrupt:
        if done:
            print(plain(ablation_table(done)))
        raise
    print(plain(ablation_table(done)))


def _write(
    about: dict[str, Any], done: Mapping[str, list[Row]], options: argparse.Namespace
) -> None:
    """What is done so far: hours of work must not hang on the last variant."""
    if options.json:
        rows = [{"variant": name, **row} for name, rows in done.items() for row in rows]
        content = about | {"variants": _differences(done), "rows": rows}
        write_text(options.json, json_text(content))
    if options.markdown:
        write_text(options.markdown, _markdown(about, done))


def _differences(done: Mapping[str, list[Row]]) -> dict[str, Any]:
    return {
        name: {
            "about": VARIANTS[name].about,
            "overrides": list(VARIANTS[name].overrides),
            "side": VARIANTS[name].side,
            "total": result_of(rows)["total"],
            "differences": compared(rows, done[DEFAULT])["differences"],
        }
        for name, rows in done.items()
    }


def ablation_table(done: Mapping[str, list[Row]]) -> Table:
    """The default's figures, and the differences of each variant to them with their intervals."""
    table: Table = [["variant", *(title for _, title in _SHOWN)]]
    for name, of in _differences(done).items():
        cells = []
        for key, _ in _SHOWN:
            if name == DEFAULT:
                value = of["total"].get(key)
                cells.append("-" if value is None else f"{value:.1f}")
                continue
            one = of["differences"].get(key)
            cells.append("-" if one is None else _change(one))
        table.append([VARIANTS[name].about, *cells])
    return table


def _change(one: Mapping[str, float]) -> str:
    if one["recordings"] == 1:
        return f"{one['mean']:+.1f} (one recording)"
    return f"{one['mean']:+.1f} ({one['low']:+.1f} to {one['high']:+.1f}){clear_mark(one)}"


def _markdown(about: Mapping[str, Any], done: Mapping[str, list[Row]]) -> str:
    total = result_of(done[DEFAULT])["total"]
    how = [
        f"| {VARIANTS[name].about} | `{' '.join(VARIANTS[name].overrides) or '-'}` |"
        for name in done
    ]
    parts = [
        "# What each part of the tracker brings",
        f"Generated at commit {about['commit'] or 'unknown'} by\n\n    {about['command']}",
        f"{total['recordings']} recordings, {total['visible']} frames with a visible hand, seeds "
        f"{', '.join(map(str, about['seeds']))}. The first row has the default's figures, the "
        "others the difference to it, paired by recording and seed, with its 90 % interval over "
        "recordings in brackets; \\* where that does not hold 0. What the columns are: "
        "[accuracy.md](../accuracy.md).",
        markdown(ablation_table(done)).replace(")*", ")\\*"),
        "| variant | overrides |\n| --- | --- |\n" + "\n".join(how),
        "Without keypoints the confidence still knows of them: its weights were fitted with "
        "them. Milliseconds are measured one variant after another, beside whatever else the "
        "machine did.",
    ]
    return "\n\n".join(parts) + "\n"
