"""How accurate the tracker is on recordings with truth: `toftrack benchmark accuracy FOLDER...`.

Tracks every recording (.npz) that has truth with every seed and prints one table: per recording and
in total, with 90 % intervals over recordings, then by sensor, pose, distance and hand length.
toftrack/evaluation/trust.py, measures.py and rows.py say what each figure is. With --labels, images
that were labelled by eye are measured, too (toftrack/evaluation/image_labels.py).

--compare FILE takes the difference to an earlier measurement, paired by recording and seed: the
gate for a change of the tracker. A * marks intervals that do not hold 0.

--peer mediapipe measures MediaPipe Hands on the amplitude images, lifted to metres by the depth
(peer_mediapipe.py says how), with the same measures, and times it in turn with the tracker.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from toftrack.configuration.compose import configuration
from toftrack.errors import ToftrackError
from toftrack.evaluation.peer import MAKE_ENVIRONMENT, PEER, peer_process
from toftrack.evaluation.results import (
    accuracy_tables,
    checked_targets,
    circumstances,
    compared,
    json_text,
    markdown,
    plain,
    read_rows,
    result_of,
    write_text,
)
from toftrack.evaluation.rows import Row
from toftrack.evaluation.runs import jobs, run_jobs, sources

_GIVEN_ELSEWHERE = ("device", "camera", "seed", "hands", "view", "stream", "smooth", "hydra")


def measure(
    options: argparse.Namespace, command: str, draw: Callable[[Path, dict[str, Any]], None]
) -> None:
    """Track, measure and report; an interruption reports what is done before it is passed on.

    command: how it was called.  draw: makes the picture of a result.
    Raises ToftrackError: something that was given cannot be used.
    """
    paths, overrides = divided(options.what, options.hands)
    checked_targets(options.json, options.markdown, options.picture)
    others = None if options.compare is None else read_rows(options.compare)
    found = sources(paths, options.labels)
    peer = _peer(options)
    todo = jobs(found, options.seeds, options.side, overrides, peer)
    about = circumstances() | {
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


def divided(words: Sequence[str], hands: int = 1) -> tuple[list[str], list[str]]:
    """Files and folders, and overrides: those are no file and have a =; the overrides are checked.

    Raises ToftrackError for an override that cannot be used, or names another recording.
    """
    overrides = [word for word in words if "=" in word and not Path(word).exists()]
    for word in overrides:
        key = word.split("=")[0].lstrip("+~")
        if key == "hand.side" or key.split(".")[0] in _GIVEN_ELSEWHERE:
            raise ToftrackError(
                f"{word} cannot be given here: recordings are named, with the camera that they "
                "have, sides, seeds and hands are given by --side, --seeds and --hands, and "
                "nothing is shown, streamed or smoothed"
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
    result = about | result_of([row for row in rows if "method" not in row])
    if "peer" in about:
        of_peer = [row for row in rows if "method" in row]
        unnamed = [{key: row[key] for key in row if key != "method"} for row in of_peer]
        result["peer"] = about["peer"] | result_of(unnamed)
    if others is not None:
        result["comparison"] = {"with": str(options.compare), **compared(result["rows"], others)}
        if not result["comparison"]["pairs"]:
            raise ToftrackError(
                f"'{options.compare}' has none of these recordings with one of these seeds, so "
                "that nothing can be compared; measure the same recordings with the same seeds"
            )
    notes = notes_of(result)
    tables = accuracy_tables(result)
    if "peer" in result:
        name = result["peer"]["name"]
        more = accuracy_tables(result["peer"])
        tables |= {
            f"{title}: {name}": [[name, *table[0][1:]], *table[1:]] for title, table in more.items()
        }
    print("\n\n".join([*(plain(table) for table in tables.values()), *notes]))
    if options.json:
        write_text(options.json, json_text(result))
    if options.markdown:
        parts = [f"`{about['command']}`, commit {about['commit'] or 'unknown'}"]
        parts += [f"## {title}\n\n{markdown(table)}" for title, table in tables.items()]
        write_text(options.markdown, "\n\n".join([*parts, *notes]) + "\n")
    if options.picture:
        draw(options.picture, result)


def notes_of(result: dict[str, Any]) -> list[str]:
    """What is to be said beside the tables."""
    notes = []
    if result["workers"] > 1:
        notes.append("note: milliseconds were measured beside other processes of this run")
    for where in ("here", "there"):
        left = (result.get("comparison") or {}).get(f"only_{where}", ())
        if left:
            some = "; ".join(left[:6]) + ("; ..." if len(left) > 6 else "")
            notes.append(f"note: {len(left)} only {where}, not compared: {some}")
    return notes
