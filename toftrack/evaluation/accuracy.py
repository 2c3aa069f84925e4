"""How accurate the tracker is on recordings with truth: `toftrack benchmark accuracy FOLDER...`.

Tracks every recording (.npz) that has truth with every seed and prints tables: per recording and in
total, with 90 % intervals over recordings, then by sensor, pose, distance and hand length.
toftrack/evaluation/trust.py, measures.py and rows.py say what each figure is. With --labels, images
that were labelled by eye are measured, too (toftrack/evaluation/image_labels.py).

--compare FILE shows the difference from an earlier measurement, paired by recording and seed: the
test that a change of the tracker must pass. With five recordings or more, a * marks intervals that
do not include 0.

--peer mediapipe measures MediaPipe Hands on the amplitude images, lifted to metres by the depth
(peer_mediapipe.py says how), with the same measures, and times it in turn with the tracker.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from toftrack.configuration.compose import configuration
from toftrack.errors import ToftrackError
from toftrack.evaluation import results
from toftrack.evaluation.figures import columns
from toftrack.evaluation.peer import MAKE_ENVIRONMENT, PEER, peer_process
from toftrack.evaluation.rows import Row
from toftrack.evaluation.runs import jobs, run_jobs, sources
from toftrack.evaluation.statistics import text_of

ABLATION = """What each part of the tracker contributes: `toftrack benchmark ablation FOLDER...`.

Tracks recordings with truth as the default does, and again with one part changed or left out, with
the same seeds; differences are paired by recording and seed, with 90 % intervals over recordings.
With five recordings or more, a * marks intervals that do not include 0.
"""


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
_GIVEN_ELSEWHERE = ("device", "camera", "seed", "hands", "view", "stream", "smooth", "hydra")


def measure(
    options: argparse.Namespace, command: str, draw: Callable[[Path, dict[str, Any]], None]
) -> None:
    """Track, measure and report, with `draw` for the picture; an interruption reports what is done
    before it is passed on. Raises ToftrackError: something that was given cannot be used."""
    paths, overrides = _divided(options.what, options.hands)
    if options.labels and options.hands > 1:
        raise ToftrackError("labelled images are of one hand; leave out --hands, or --labels")
    results.checked_targets(options.json, options.markdown, options.picture)
    others = None if options.compare is None else results.read_rows(options.compare)
    found = sources(paths, options.labels)
    peer = _peer(options)
    todo = jobs(found, options.seeds, options.side, overrides, peer)
    about = results.circumstances() | {
        "command": command,
        "side": options.side,
        "hands": options.hands,
        "seeds": options.seeds,
        "workers": options.workers,
        "overrides": overrides,
    }
    if peer is not None:
        about["peer"] = {"name": PEER, **peer_process(peer).versions}
    rows: list[Row] = []
    try:
        for more in run_jobs(todo, options.workers):
            rows += more
    except KeyboardInterrupt:
        if rows:
            _report(about | {"interrupted": True}, rows, None, options, draw)
        raise
    _report(about, rows, others, options, draw)


def _peer(options: argparse.Namespace) -> str | None:
    """Its Python."""
    if options.peer is None:
        return None
    if options.peer_python is None:
        raise ToftrackError(
            f"--peer {options.peer} runs in an environment of its own, and --peer-python does not "
            f"say where that is; {MAKE_ENVIRONMENT}; then give --peer-python peer/bin/python"
        )
    if options.hands > 1:
        raise ToftrackError("--peer is measured with one hand; leave out --hands, or --peer")
    return str(options.peer_python)


def _divided(words: Sequence[str], hands: int = 1) -> tuple[list[str], list[str]]:
    """Files and folders, and overrides, which are no file and have a =. Raises ToftrackError for an
    override that cannot be used, or names another recording."""
    overrides = [word for word in words if "=" in word and not Path(word).exists()]
    for word in overrides:
        key = word.split("=")[0].lstrip("+~")
        elsewhere = key.split(".")[0] in _GIVEN_ELSEWHERE and key != "hydra.searchpath"
        if key == "hand.side" or elsewhere:
            raise ToftrackError(
                f"{word} cannot be given here: recordings come with their cameras, --side, --seeds "
                "and --hands give sides, seeds and the number of hands, and nothing is shown, "
                "streamed or smoothed"
            )
    if hands > 1:
        overrides.append(f"hands={hands}")
    configuration(*overrides)  # an error now, not in the first process that tracks
    return [word for word in words if word not in overrides], overrides


def _report(
    about: dict[str, Any],
    rows: Sequence[Row],
    others: Sequence[Row] | None,
    options: argparse.Namespace,
    draw: Callable[[Path, dict[str, Any]], None],
) -> None:
    result = about | results.result_of([row for row in rows if "method" not in row])
    if others is not None:
        found = results.compared(result["rows"], others)
        if not found["pairs"]:
            raise ToftrackError(
                f"'{options.compare}' has none of these recordings with one of these seeds, so "
                "that nothing can be compared; measure the same recordings with the same seeds"
            )
        result["comparison"] = {"with": str(options.compare), **found}
    notes = notes_of(result)
    tables = results.accuracy_tables(result)
    if "peer" in about:
        of_peer = [row for row in rows if "method" in row]
        unnamed = [{key: row[key] for key in row if key != "method"} for row in of_peer]
        result["peer"] = about["peer"] | results.result_of(unnamed)
        for title, table in results.accuracy_tables(result["peer"]).items():
            tables[f"{title}: {PEER}"] = [[PEER, *table[0][1:]], *table[1:]]
    if options.json:
        results.write_text(options.json, results.json_text(result))
    if options.markdown:
        parts = [f"`{about['command']}`, commit {about['commit'] or 'unknown'}"]
        parts += [f"## {title}\n\n{results.markdown(table)}" for title, table in tables.items()]
        results.write_text(options.markdown, "\n\n".join([*parts, *notes]) + "\n")
    # After the files, which a reader that goes away must not cost.
    print("\n\n".join([*map(results.plain, tables.values()), *notes]))
    if options.picture:
        draw(options.picture, result)


def notes_of(result: dict[str, Any]) -> list[str]:
    """What is to be said beside the tables."""
    notes = []
    if result["workers"] > 1:
        notes.append("note: milliseconds were measured beside other processes of this run")
    comparison = result.get("comparison") or {}
    counts = [one["recordings"] for one in comparison.get("differences", {}).values()]
    if 1 < max(counts, default=0) < results.FEWEST_FOR_A_STAR:
        fewest = results.FEWEST_FOR_A_STAR
        notes.append(f"note: intervals of fewer than {fewest} recordings say little, and get no *")
    for where in ("here", "there"):
        left = comparison.get(f"only_{where}", ())
        if left:
            some = "; ".join(left[:6]) + ("; ..." if len(left) > 6 else "")
            notes.append(f"note: {len(left)} only {where}, not compared: {some}")
    return notes


def ablate(options: argparse.Namespace, command: str) -> None:
    """Track with each variant, measure and report; an interruption reports the variants that are
    done before it is passed on. Raises ToftrackError: something that was given cannot be used."""
    names = [DEFAULT, *(name for name in options.variants if name != DEFAULT)]
    paths, overrides = _divided(options.what)
    results.checked_targets(options.json, options.markdown)
    found = sources(paths)
    about = results.circumstances()
    about |= {"command": command, "seeds": options.seeds, "overrides": overrides}
    done: dict[str, list[Row]] = {}
    try:
        for number, name in enumerate(names, 1):
            chosen = [*overrides, *VARIANTS[name].overrides]
            todo = jobs(found, options.seeds, VARIANTS[name].side, chosen)
            words = f"{name} ({number} of {len(names)})"
            done[name] = [row for rows in run_jobs(todo, options.workers, words) for row in rows]
            _write_ablation(about, done, options)
    except KeyboardInterrupt:
        if done:
            print(results.plain(ablation_table(done)))
        raise
    print(results.plain(ablation_table(done)))


def _write_ablation(
    about: dict[str, Any], done: Mapping[str, list[Row]], options: argparse.Namespace
) -> None:
    """What is done so far: hours of work must not hang on the last variant."""
    if options.json:
        rows = [{"variant": name, **row} for name, rows in done.items() for row in rows]
        content = about | {"variants": _differences(done), "rows": rows}
        results.write_text(options.json, results.json_text(content))
    if options.markdown:
        results.write_text(options.markdown, _ablation_page(about, done))


def _differences(done: Mapping[str, list[Row]]) -> dict[str, Any]:
    return {
        name: {
            "about": VARIANTS[name].about,
            "overrides": list(VARIANTS[name].overrides),
            "side": VARIANTS[name].side,
            "total": results.result_of(rows)["total"],
            "differences": results.compared(rows, done[DEFAULT])["differences"],
        }
        for name, rows in done.items()
    }


def ablation_table(done: Mapping[str, list[Row]]) -> results.Table:
    """The default's figures, and the differences of each variant to them with their intervals."""
    table: results.Table = [["variant", *(heading for heading, *_ in columns("ablation"))]]
    for name, of in _differences(done).items():
        if name == DEFAULT:
            cells = [text_of(of["total"].get(key)) for _, key, _ in columns("ablation")]
        else:
            cells = [_change(of["differences"].get(key)) for _, key, _ in columns("ablation")]
        table.append([VARIANTS[name].about, *cells])
    return table


def _change(one: Mapping[str, float] | None) -> str:
    if one is None:
        return "-"
    if one["recordings"] == 1:
        return f"{one['mean']:+.1f} (one recording)"
    mark = results.clear_mark(one)
    return f"{one['mean']:+.1f} ({one['low']:+.1f} to {one['high']:+.1f}){mark}"


def _ablation_page(about: Mapping[str, Any], done: Mapping[str, list[Row]]) -> str:
    total = results.result_of(done[DEFAULT])["total"]
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
        results.markdown(ablation_table(done)).replace(")*", ")\\*"),
        "| variant | overrides |\n| --- | --- |\n" + "\n".join(how),
        "Without keypoints the confidence still knows of them: its weights were fitted with "
        "them. Milliseconds are measured one variant after another, beside whatever else the "
        "machine did.",
    ]
    return "\n\n".join(parts) + "\n"
