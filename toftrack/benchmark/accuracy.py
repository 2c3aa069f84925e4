"""How accurate the tracker is on recordings with truth: `toftrack benchmark accuracy FOLDER...`.

Tracks every recording (.npz) that has truth with every seed and prints one table: per recording and
in total, with 90 % intervals over recordings, then by sensor, pose, distance and hand length.
toftrack/output/trust.py, measures.py and accuracy.py say what each figure is. With --labels, images
that were labelled by eye are measured, too (toftrack/output/image_labels.py).

--compare FILE takes the difference to an earlier measurement, paired by recording and seed: the
gate for a change of the tracker. A * marks intervals that do not hold 0.

--peer mediapipe measures MediaPipe Hands on the amplitude images, lifted to metres by the depth
(peer_mediapipe.py says how), with the same measures, and times it in turn with the tracker.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from toftrack.benchmark.peer import MAKE_ENVIRONMENT, PEERS, peer_process
from toftrack.benchmark.results import (
    checked_targets,
    circumstances,
    comparison_with,
    json_text,
    read_rows,
    result_of,
    write_text,
)
from toftrack.benchmark.runs import SIDES, Job, jobs, run_jobs, sources
from toftrack.checks import MOST_HANDS
from toftrack.configuration.compose import configuration
from toftrack.errors import ToftrackError, reported_errors
from toftrack.output.accuracy import Row
from toftrack.output.accuracy_tables import accuracy_tables, markdown, plain
from toftrack.safe_files import write_whole

_TIMED_BESIDE = "milliseconds were measured beside other processes of this run"

_GIVEN_ELSEWHERE = ("device", "camera", "seed", "hands", "view", "stream", "smooth", "hydra")


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line, track, report. Raises ToftrackError.

    An interruption reports what is done before it is passed on.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    options = _parser().parse_intermixed_args(arguments)
    paths, overrides = divided(options.what, options.side, options.hands)
    checked_targets(options.json, options.markdown, options.picture)
    others = None if options.compare is None else read_rows(options.compare)
    found = sources(paths, options.labels)
    peer = _peer(options)
    todo = jobs(found, options.seeds, options.side, overrides, peer)
    about = circumstances() | {
        "command": shlex.join(["toftrack", "benchmark", "accuracy", *arguments]),
        "side": options.side,
        "hands": options.hands,
        "seeds": options.seeds,
        "workers": options.workers,
        "overrides": overrides,
    }
    if peer is not None:
        about["peer"] = {"name": peer[0], **peer_process(*peer).versions}
    rows: list[Row] = []

    def done(job: Job, more: list[Row]) -> None:
        rows.extend(more)

    try:
        run_jobs(todo, options.workers, done)
    except KeyboardInterrupt:
        if rows:
            _report(about | {"interrupted": True}, rows, None, options)
        raise
    _report(about, rows, others, options)


def _peer(options: argparse.Namespace) -> tuple[str, str] | None:
    if options.peer is None:
        return None
    if options.peer_python is None:
        raise ToftrackError(
            f"--peer {options.peer} runs in an environment of its own, and --peer-python does not "
            f"say where that is; {MAKE_ENVIRONMENT}; then give --peer-python peer/bin/python"
        )
    if options.hands > 1:
        raise ToftrackError("--peer is measured with one hand; leave out --hands, or --peer")
    return options.peer, str(options.peer_python)


def divided(words: Sequence[str], side: str, hands: int) -> tuple[list[str], list[str]]:
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
) -> None:
    result = about | result_of([row for row in rows if "method" not in row])
    if "peer" in about:
        of_peer = result_of(
            [
                {key: value for key, value in row.items() if key != "method"}
                for row in rows
                if "method" in row
            ]
        )
        result["peer"] = about["peer"] | of_peer
    if others is not None:
        result["comparison"] = comparison_with(result["rows"], others, str(options.compare))
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
        write_picture(options.picture, result)


def notes_of(result: dict[str, Any]) -> list[str]:
    """What is to be said beside the tables."""
    notes = []
    if result["workers"] > 1:
        notes.append(f"note: {_TIMED_BESIDE}")
    for where in ("here", "there"):
        left = (result.get("comparison") or {}).get(f"only_{where}", ())
        if left:
            some = "; ".join(left[:6]) + ("; ..." if len(left) > 6 else "")
            notes.append(f"note: {len(left)} only {where}, not compared: {some}")
    return notes


def write_picture(path: Path, result: dict[str, Any]) -> None:
    """The picture of a result; ToftrackError where it cannot be written or drawn."""
    import cv2

    from toftrack.views.figures.runs import accuracy_figure

    if not result["each"]:
        raise ToftrackError(
            "--picture shows recordings with truth, and there is none; leave it out"
        )
    kind = path.suffix if path.suffix.lower() in (".png", ".jpg") else ".png"
    done, data = cv2.imencode(kind, accuracy_figure(result["each"], result["total"]))
    assert done
    with reported_errors(f"the picture '{path}' cannot be written", "choose another place"):
        write_whole(path, data.tobytes())


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What accuracy and ablation have in common."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "what",
        nargs="+",
        metavar="FOLDER",
        help="folders of recordings, or recordings; KEY=VALUE is an override as for track.py",
    )
    parser.add_argument("--seeds", type=_seeds, default=[0], help="separated by commas (0)")
    parser.add_argument(
        "--workers", type=_workers, default=1, metavar="N", help="processes (1); figures stay"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything there")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables there")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="toftrack benchmark accuracy", description=__doc__)
    add_arguments(parser)
    parser.add_argument(
        "--side",
        choices=SIDES,
        default="told",
        help="handedness: told, by the truth, or auto, detected while tracking (told)",
    )
    hands = range(1, MOST_HANDS + 1)
    parser.add_argument("--hands", type=int, choices=hands, default=1, help="followed at once (1)")
    parser.add_argument(
        "--labels",
        type=Path,
        metavar="FILE",
        action="append",
        default=[],
        help="of a recording without truth; may be given several times",
    )
    parser.add_argument("--compare", type=Path, metavar="FILE", help="an earlier --json")
    parser.add_argument("--peer", choices=PEERS, help="measure another method, too")
    parser.add_argument("--peer-python", type=Path, metavar="PYTHON", help="of its environment")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the shares there (.png)")
    return parser


def _seeds(text: str) -> list[int]:
    seeds = list(dict.fromkeys(int(part) for part in text.split(",")))
    if min(seeds) < 0:
        raise ValueError
    return seeds


def _workers(text: str) -> int:
    count = int(text)
    if not 1 <= count <= 4 * (os.cpu_count() or 1):
        raise ValueError
    return count
