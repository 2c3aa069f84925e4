"""Evaluate the tracker on a public data set: `toftrack evaluate MSRA15 FOLDER`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from toftrack.configuration.compose import searched
from toftrack.errors import check_choice
from toftrack.evaluation.datasets import DATA_SETS, LabelledSequence, open_data_set
from toftrack.evaluation.public import evaluate, table, totals
from toftrack.evaluation.results import checked_targets, write_text
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.programs.command_line import plain_parser


def main(arguments: Sequence[str]) -> None:
    """Parse the command line, track, print the table. Raises ToftrackError."""
    parser = plain_parser("toftrack evaluate", __doc__)
    add = parser.add_argument
    add("data_set", metavar="DATASET", help=", ".join(DATA_SETS))
    add("folder", metavar="FOLDER", help="where the data set lies")
    about = "a setting as for track.py, filter.particles=1000"
    add("overrides", metavar="OVERRIDE", nargs="*", default=[], help=about)
    add("--config-dir", help="folder of choices of your own (docs/extending.md)")
    add("--sequences", help="only these, by name, separated by commas: P0/1,P0/2")
    about = "only this many at the start of each sequence"
    parser.add_number("--frames", 1, whole=True, help=about)
    about = "how far the labels' fingertips lie inside ours, instead of what the data set gives"
    add("--tip-inset", type=float, metavar="MM", help=about)
    add("--json", type=Path, metavar="FILE", help="write the figures here, too")
    options = parser.parse_intermixed_args(arguments)
    if options.config_dir is not None:
        options.overrides.insert(0, searched(options.config_dir))
    checked_targets(options.json)
    data_set, sequences = open_data_set(options.data_set, options.folder)
    sequences = _chosen(sequences, options.sequences)
    inset_m = data_set.tip_inset_m if options.tip_inset is None else options.tip_inset / 1e3
    figures = evaluate(data_set, sequences, options.overrides, inset_m, options.frames)
    if options.json:
        facts = {
            "data_set": data_set.name,
            "folder": str(options.folder),
            "overrides": options.overrides,
            "joints": [JOINT_NAMES[row] for row in data_set.joints],
            "tips": data_set.tips,
            "tip_inset_mm": 1e3 * inset_m,
            "total": totals(figures),
            "sequences": figures,
        }
        write_text(options.json, json.dumps(facts, indent=1, allow_nan=False) + "\n")
    print(table(figures))
    print(f"compared: {', '.join(JOINT_NAMES[row] for row in data_set.joints)}")
    print(f"tips: {data_set.tips}; ours are moved {1e3 * inset_m:g} mm inwards")


def _chosen(sequences: list[LabelledSequence], names: str | None) -> list[LabelledSequence]:
    known = {sequence.name: sequence for sequence in sequences}
    chosen = known if names is None else names.split(",")
    for name in chosen:
        check_choice("--sequences", name, known)
    return [known[name] for name in chosen]
