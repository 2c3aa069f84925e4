"""`toftrack benchmark [speed | alternating | accuracy | ablation]`: speed where none is named."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from toftrack.configuration.compose import searched
from toftrack.errors import MOST_HANDS, ToftrackError, check_choice, reported_errors
from toftrack.programs.command_line import Parser, plain_parser, typed


def main(arguments: Sequence[str]) -> None:
    """Run a measurement. Raises ToftrackError."""
    kinds = {
        "speed": _speed,
        "alternating": _alternating,
        "accuracy": _accuracy,
        "ablation": _ablation,
    }
    first = arguments[0] if arguments else "speed"
    if first in ("-h", "--help"):
        print(
            "usage: toftrack benchmark [speed] ...       time of hypotheses and frames\n"
            "       toftrack benchmark alternating ...   frames in turn with MediaPipe's; starts\n"
            "       toftrack benchmark accuracy ...      accuracy on recordings with truth\n"
            "       toftrack benchmark ablation ...      what each part of the tracker adds\n\n"
            "toftrack benchmark speed --help, and so on, says more"
        )
    elif first.startswith("-"):
        _speed(arguments)
    elif first in kinds:
        kinds[first](arguments[1:])
    else:
        raise ToftrackError(f"there is no benchmark '{first}'; give one of {', '.join(kinds)}")


def _speed(arguments: Sequence[str]) -> None:
    from toftrack.evaluation import results, speed

    parser = plain_parser("toftrack benchmark", speed.__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    counts = list(speed.PARTICLES)
    about = f"how many hypotheses to time ({' '.join(map(str, counts))})"
    number = parser.add_number
    number("--particles", 1, whole=True, nargs="+", default=counts, metavar="N", help=about)
    about = "device that scores (cpu)"
    parser.add_argument("--compute", choices=("cpu", "cuda"), default="cpu", help=about)
    about = "how long to time each method (1)"
    parser.add_argument("--seconds", type=float, default=1.0, help=about)
    parser.add_argument("--frames", action="store_true", help="time whole frames, too")
    parser.add_argument("--no-baselines", action="store_true", help="leave the slow methods out")
    given = parser.parse_args(arguments)
    results.checked_targets(given.json)
    baselines = not given.no_baselines
    result = speed.run(given.particles, given.compute, given.seconds, given.frames, baselines)
    if given.json:
        results.write_text(given.json, json.dumps(result, indent=1) + "\n")


def _alternating(arguments: Sequence[str]) -> None:
    from toftrack.evaluation import alternating, results

    parser = plain_parser("toftrack benchmark alternating", alternating.__doc__)
    about = "rounds of all programs (5); 0 = none"
    parser.add_number("--rounds", 0, whole=True, default=5, help=about)
    parser.add_number("--starts", 0, whole=True, default=0, help="starts to time (0)")
    parser.add_number("--cores", 1, whole=True, help="how many all may use, if it can be set")
    about = "recordings with truth of two hands"
    parser.add_argument("--two-hands", nargs="+", default=[], metavar="RECORDING", help=about)
    parser.add_argument("--peer-python", metavar="PYTHON", help="Python of MediaPipe's environment")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    given = parser.parse_args(arguments)
    results.checked_targets(given.json)
    result = alternating.measure(
        given.rounds, given.starts, given.cores, given.two_hands, given.peer_python
    )
    if given.json:
        results.write_text(given.json, json.dumps(result) + "\n")


def _accuracy(arguments: Sequence[str]) -> None:
    from toftrack.evaluation import accuracy
    from toftrack.evaluation.peer import PEER
    from toftrack.evaluation.runs import SIDES

    parser = _parser_of_recordings("accuracy", accuracy.__doc__)
    about = "handedness: told = given by the truth, auto = detected while tracking (told)"
    parser.add_argument("--side", choices=SIDES, default="told", help=about)
    hands = range(1, MOST_HANDS + 1)
    parser.add_argument("--hands", type=int, choices=hands, default=1, help="tracked at once (1)")
    about = "labels of a recording without truth; may be given several times"
    add = parser.add_argument
    add("--labels", type=Path, metavar="FILE", action="append", default=[], help=about)
    parser.add_argument("--compare", type=Path, metavar="FILE", help="file of an earlier --json")
    parser.add_argument("--peer", choices=(PEER,), help="measure another method, too")
    parser.add_argument(
        "--peer-python", type=Path, metavar="PYTHON", help="Python of its environment"
    )
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the shares there (.png)")
    command = typed(["toftrack", "benchmark", "accuracy", *arguments])
    accuracy.measure(_options(parser, arguments), command, _write_picture)


def _ablation(arguments: Sequence[str]) -> None:
    from toftrack.evaluation import accuracy

    known = list(accuracy.VARIANTS)

    def variants(text: str) -> list[str]:
        names = text.split(",")
        for name in names:
            check_choice("--variants", name, known)
        return names

    parser = _parser_of_recordings("ablation", accuracy.ABLATION)
    about = f"only some, separated by commas: {', '.join(known)}"
    parser.add_argument("--variants", type=variants, default=known, metavar="NAMES", help=about)
    command = typed(["toftrack", "benchmark", "ablation", *arguments])
    accuracy.ablate(_options(parser, arguments), command)


def _parser_of_recordings(name: str, about: str | None) -> Parser:
    """With what accuracy and ablation have in common."""
    parser = plain_parser(f"toftrack benchmark {name}", about)
    about = "folders of recordings, or recordings; KEY=VALUE is an override as for track.py"
    parser.add_argument("what", nargs="+", metavar="FOLDER", help=about)
    parser.add_argument("--seeds", type=_seeds, default=[0], help="seeds, separated by commas (0)")
    parser.add_argument("--config-dir", help="folder of choices of your own (docs/extending.md)")
    about = "processes (1); does not change the figures"
    most = 4 * (os.cpu_count() or 1)
    parser.add_number("--workers", 1, most, whole=True, default=1, metavar="N", help=about)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all results there")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables there")
    return parser


def _options(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    options = parser.parse_intermixed_args(arguments)
    if options.config_dir is not None:  # as an override it goes to the workers, too
        options.what.append(searched(options.config_dir))
    return options


def _seeds(text: str) -> list[int]:
    seeds = list(dict.fromkeys(part.strip() for part in text.split(",")))
    if not all(map(str.isdecimal, seeds)):
        raise argparse.ArgumentTypeError(f"'{text}' must be whole numbers from 0 on, as 0,1,2")
    return list(map(int, seeds))


def _write_picture(path: Path, result: dict[str, Any]) -> None:
    """The picture of a result; ToftrackError where it cannot be written or drawn."""
    from toftrack.views.figures.runs import accuracy_figure
    from toftrack.views.pictures import write_picture

    if not result["each"]:
        raise ToftrackError(
            "--picture shows recordings with truth, and there is none; leave it out"
        )
    picture = accuracy_figure(result["each"], result["total"])
    with reported_errors(f"the picture '{path}' cannot be written", "choose another place"):
        write_picture(path, picture)
