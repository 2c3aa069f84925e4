"""Evaluate the tracker on a public data set: `toftrack evaluate MSRA15 FOLDER`.

Each sequence is tracked from its first frame by a tracker of its own, with the side of the data
set's hands. The figures are those of toftrack's own recordings, over the joints that the labels
share with it, its fingertips moved to where the data set has them.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from toftrack.api import make_tracker
from toftrack.errors import ToftrackError, reported_errors
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.accuracy_tables import plain, table_of
from toftrack.output.evaluation import TIPS
from toftrack.output.trust import OK_MM, Hand, interval, trust
from toftrack.programs import command_line
from toftrack.recordings.datasets import DATA_SETS, open_data_set
from toftrack.recordings.datasets.base import DataSet, LabelledSequence, compared_joints
from toftrack.safe_files import write_whole


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line, track, print the table. Raises ToftrackError."""
    options = _parser().parse_intermixed_args(arguments)
    data_set, sequences = open_data_set(options.data_set, options.folder)
    sequences = _chosen(sequences, options.sequences)
    inset_m = data_set.tip_inset_m if options.tip_inset is None else options.tip_inset / 1e3
    figures = evaluate(data_set, sequences, options.overrides, inset_m, options.frames)
    print(table(figures))
    print(f"compared: {', '.join(JOINT_NAMES[row] for row in data_set.joints)}")
    print(f"tips: {data_set.tips}; ours are moved {1e3 * inset_m:g} mm inwards")
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
        with reported_errors(f"'{options.json}' cannot be written", "choose another place"):
            write_whole(options.json, json.dumps(facts, indent=1, allow_nan=False) + "\n")


def evaluate(
    data_set: DataSet,
    sequences: Sequence[LabelledSequence],
    overrides: Sequence[str],
    tip_inset_m: float,
    frames: int | None = None,
) -> dict[str, dict[str, Any]]:
    """Track sequences and compare them with their labels; the figures by the sequences' names.

    Args:
        overrides: of the tracker's configuration; hand.side among them goes before the data set's.
        tip_inset_m: as for `compared_joints`.
        frames: so many at the start of each sequence only.

    Raises:
        ToftrackError: an override or a file cannot be used.
    """
    counts = [
        len(sequence) if frames is None else min(frames, len(sequence)) for sequence in sequences
    ]
    figures = {}
    with tqdm(total=sum(counts), unit=" frames", file=sys.stderr, mininterval=0.5) as bar:
        for sequence, count in zip(sequences, counts, strict=True):
            bar.set_postfix_str(sequence.name, refresh=False)
            if sequence.left_out:
                bar.write(
                    f"note: {sequence.name}: {sequence.left_out} labels have no image and are left "
                    "out",
                    file=sys.stderr,
                )
            joints, lost = _track(sequence, count, overrides, bar)
            figures[sequence.name] = labelled_figures(
                compared_joints(joints, data_set.joints, tip_inset_m),
                lost,
                sequence.joints_m[:count],
                data_set.joints,
            )
    return figures


def _track(
    sequence: LabelledSequence, count: int, overrides: Sequence[str], bar: tqdm
) -> tuple[np.ndarray, np.ndarray]:
    """(T, 21, 3) metres and lost, (T,) bool, of the first frames."""
    tracker = make_tracker(f"hand.side={sequence.side}", *overrides)
    joints, lost = np.full((count, 21, 3), np.nan), np.ones(count, bool)
    for index in range(count):
        depth_m = sequence.frame(index)
        estimate = tracker.step(depth_m, sequence.camera.K, index, index / sequence.fps)
        joints[index], lost[index] = estimate.joints_m, estimate.lost
        bar.update()
    return joints, lost


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="toftrack evaluate",
        description="Evaluate the tracker on a public data set of labelled depth images.",
    )
    parser.add_argument("data_set", metavar="DATASET", help=", ".join(DATA_SETS))
    parser.add_argument("folder", metavar="FOLDER", help="where the data set lies")
    parser.add_argument(
        "overrides",
        metavar="OVERRIDE",
        nargs="*",
        default=[],
        help="as for track.py, filter.particles=1000",
    )
    parser.add_argument("--sequences", help="only those, by name, separated by commas: P0/1,P0/2")
    parser.add_argument("--frames", type=_count, help="only so many at the start of each sequence")
    parser.add_argument(
        "--tip-inset",
        type=float,
        metavar="MM",
        help="how far the labels' fingertips lie inside of ours, instead of the data set's own",
    )
    parser.add_argument("--json", metavar="FILE", help="write the figures here, too")
    return parser


def _count(text: str) -> int:
    count = int(text)
    if count < 1:
        raise ValueError
    return count


def _chosen(sequences: list[LabelledSequence], names: str | None) -> list[LabelledSequence]:
    if names is None:
        return sequences
    known = {sequence.name: sequence for sequence in sequences}
    for name in names.split(","):
        if name not in known:
            raise ToftrackError(f"there is no sequence '{name}'; there are {', '.join(known)}")
    return [known[name] for name in names.split(",")]


if __name__ == "__main__":
    sys.exit(command_line.run(main))


_PERCENT = ("within_pct", "usable_pct", "partly_pct", "silent_pct", "false_alarm_pct")
_COLUMNS = (
    ("frames", "frames", 0),
    ("mean mm", "mean_mm", 1),
    ("median", "median_mm", 1),
    ("tips", "fingertip_mm", 1),
    ("all<40", "within_pct", 1),
    ("usable", "usable_pct", 1),
    ("silent", "silent_pct", 1),
    ("false al.", "false_alarm_pct", 1),
    ("first right", "first_right", 0),
)


def labelled_figures(
    joints_m: np.ndarray, lost: np.ndarray, true_m: np.ndarray, joints: tuple[int, ...]
) -> dict[str, Any]:
    """The figures of one sequence in which the hand is always in view, JSON-able, unrounded.

    Errors are over all frames with an estimate, lost or not, None where there is none; frames
    without one (`missing_pct`) are never `within_pct`, where every joint is within 40 mm. The
    others are those of trust.py.

    Args:
        joints_m: (T, J, 3) estimates in metres, with joints as the labels define them; not finite
            where there is none.
        lost: (T,) bool.
        true_m: (T, J, 3) labels in metres.
        joints: which of toftrack's joints the J are.

    Raises:
        ToftrackError: the shapes do not fit.
    """
    of = trust(joints_m, lost, Hand(true_m, np.ones(len(true_m), bool)))
    finite = np.isfinite(joints_m).all(axis=(1, 2))
    error = 1e3 * np.linalg.norm(joints_m[finite] - true_m[finite], axis=2)
    tips = error[:, np.isin(joints, TIPS)]
    count = max(len(finite), 1)
    return {
        "frames": len(finite),
        "missing_pct": 100.0 * float((~finite).sum()) / count,
        "mean_mm": float(error.mean()) if error.size else None,
        "median_mm": float(np.median(error)) if error.size else None,
        "fingertip_mm": float(tips.mean()) if tips.size else None,
        "within_pct": 100.0 * float((error.max(axis=1) <= OK_MM).sum()) / count,
        "mean_not_lost_mm": of.mean_mm,
        "first_right": of.first_right,
        **{name: getattr(of, name) for name in _PERCENT[1:]},
        "longest_silent": of.longest_silent,
    }


def totals(sequences: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Means over sequences, JSON-able, with 90 % intervals of the shares usable and silent."""
    rows = list(sequences.values())
    total: dict[str, Any] = {
        "sequences": len(rows),
        "frames": sum(row["frames"] for row in rows),
        "never_right": sum(row["first_right"] is None for row in rows),
    }
    for name in ("mean_mm", "median_mm", "fingertip_mm", "mean_not_lost_mm", *_PERCENT):
        values = [row[name] for row in rows if row[name] is not None]
        total[name] = float(np.mean(values)) if values else None
    for name in ("usable_pct", "silent_pct"):
        share = interval([row[name] for row in rows])
        total[f"{name.removesuffix('_pct')}_90"] = [share.low, share.high]
    return total


def table(sequences: Mapping[str, dict[str, Any]]) -> str:
    """One row a sequence and one of their means, without final newline. Shares in per cent."""
    mean = {"mean": totals(sequences)} if len(sequences) > 1 else {}
    return plain(table_of(_COLUMNS, {**sequences, **mean}, "sequence"))
