"""Choose when a joint may be used, `joint_ok`, on half of some recordings, and show what it does on
the other half:

python -m toftrack.programs.fit_joint_flags FOLDER... [--labels FILE]
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit
from tqdm import tqdm

from toftrack.api import make_tracker
from toftrack.benchmark.runs import Source, sources
from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.frames import Truth
from toftrack.output.evaluation import TIPS
from toftrack.output.image_labels import Points, lateral_errors_mm, read_labels
from toftrack.output.trust import OK_MM
from toftrack.programs import command_line
from toftrack.tracking.confidence import JointFlags, flag_columns

_SHRINK = 20.0
"""Prior precision of weights of columns in standard deviations, in fingertips."""
_RATES = (1, 2, 3, 4, 5, 7, 10, 15, 20)
"""Per cent of the right fingertips that are flagged, in the table."""


@dataclass(frozen=True, eq=False)
class Tips:
    """N visible fingertips in frames that are not flagged lost.

    columns: (N, 3), see flag_columns.  wrong: (N,) more than 40 mm off.
    shown: (N,) of a recording on which nothing is chosen.
    """

    columns: np.ndarray
    wrong: np.ndarray
    shown: np.ndarray

    def half(self, shown: bool) -> Tips:
        """Those on which the flags are chosen, or those on which they are shown."""
        rows = self.shown == shown
        return Tips(self.columns[rows], self.wrong[rows], self.shown[rows])


def read_arguments(arguments: list[str] | None) -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(
        prog="python -m toftrack.programs.fit_joint_flags",
        description="Choose lost.joint_ok on every second recording of each folder, show it on the"
        " others, and print it.",
    )
    parser.add_argument("recordings", nargs="+", help=".npz files or folders of them, with truth")
    parser.add_argument(
        "--labels", action="append", default=[], metavar="FILE", help="of images without truth"
    )
    parser.add_argument("--seeds", type=int, default=1, help="how many runs of each (1)")
    parser.add_argument(
        "--right", type=float, default=4.0, help="per cent of the right tips to be flagged (4)"
    )
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="settings")
    parser.add_argument("--output", type=Path, help="a .json file for the figures")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    """Track, choose, report."""
    asked = read_arguments(arguments)
    if not 0 < asked.right < 100:
        raise ToftrackError(f"--right {asked.right:g} is no share; give per cent, as 4")
    found = sources(asked.recordings, asked.labels)
    todo = [(one, seed) for one in found for seed in range(1, asked.seeds + 1)]
    parts = [
        observed(one, seed, is_shown(one, found), asked.settings)
        for one, seed in tqdm(todo, unit=" recordings", file=sys.stderr)
    ]
    tips = joined(parts)
    flags = chosen(tips.half(False), asked.right)
    report = {
        "joint_ok": vars(flags),
        "chosen_on": rates(tips.half(False), flags),
        "shown_on": rates(tips.half(True), flags),
        "curve": curve(tips.half(True), flags),
    }
    if asked.output is not None:
        asked.output.write_text(json.dumps(report, indent=1) + "\n")
    print("\n".join(lines(report)))


def is_shown(one: Source, found: list[Source]) -> bool:
    """Whether nothing is chosen on a recording: every second one of its folder."""
    return [source for source in found if source.path.parent == one.path.parent].index(one) % 2 == 1


def observed(one: Source, seed: int, shown: bool, settings: list[str]) -> Tips:
    """The fingertips of a recording.  shown: as in Tips."""
    labels = None if one.labels is None else read_labels(one.labels)
    if labels is not None and not isinstance(labels, Points):
        raise ToftrackError(f"'{one.labels}' labels no points; give labels of fingertips")
    with Replay(one.path) as device:
        truth, k = device.truth, device.camera.K
        side = labels.side if labels is not None else truth.side if truth else ""
        if side not in ("right", "left"):
            raise ToftrackError(f"'{one.path}' does not say whose hand it shows; leave it out")
        tracker = make_tracker(f"hand.side={side}", f"seed={seed}", *settings)
        joints, columns = [], []
        for frame in device:
            depth = device.camera.rectify(frame.depth, frame.radial)
            estimate = tracker.step(depth, k, frame.index, frame.timestamp_s)
            info = tracker.info
            nothing = info is None or info.joint_features is None or estimate.lost
            joints.append(estimate.joints_m)
            columns.append(
                np.full((21, 3), np.nan)
                if nothing
                else flag_columns(
                    estimate.joint_confidence, estimate.confidence, info.joint_features
                )
            )
    off = _tips_off_mm(np.array(joints), truth if labels is None else labels, k)
    of_tips = np.array(columns)[:, TIPS]
    used = np.isfinite(off) & np.isfinite(of_tips).all(2)
    return Tips(of_tips[used], off[used] > OK_MM, np.full(used.sum(), shown))


def _tips_off_mm(joints_m: np.ndarray, known: Truth | Points, k: np.ndarray) -> np.ndarray:
    """(T, 5) errors of visible fingertips, of labelled ones laterally; others are NaN."""
    if isinstance(known, Truth):
        off = 1e3 * np.linalg.norm(joints_m - known.joints_m, axis=2)[:, TIPS]
        seen = np.asarray(known.visible, bool)[:, None]
        if known.joint_visible is not None:
            seen = seen & known.joint_visible[:, TIPS]
        return np.where(seen, off, np.nan)
    errors = np.full((len(joints_m), len(TIPS)), np.nan)
    for number, off in lateral_errors_mm(known, joints_m, k, TIPS).items():
        for row, value in off.items():
            errors[number, TIPS.index(row)] = value
    return errors


def joined(parts: list[Tips]) -> Tips:
    """All of them."""
    columns, wrong, shown = zip(*((p.columns, p.wrong, p.shown) for p in parts), strict=True)
    return Tips(np.concatenate(columns), np.concatenate(wrong), np.concatenate(shown))


def chosen(tips: Tips, right_pct: float) -> JointFlags:
    """Weights by a logistic model of what is wrong; the least such that so many right tips fall
    below it.

    Nothing may make a joint surer but its own confidence and the estimate's, and nothing but what
    covers it less sure: three numbers, for a half of few recordings.
    """
    if not tips.wrong.any() or tips.wrong.all():
        raise ToftrackError(
            "no fingertip of the half on which is chosen is wrong, or none is right: give more "
            "recordings, or other ones"
        )
    signed = tips.columns * (1, 1, -1)
    mean, spread = signed.mean(0), signed.std(0) + 1e-9
    z, right = (signed - mean) / spread, 1.0 - tips.wrong

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        odds = z @ parameters[1:] + parameters[0]
        off = expit(odds) - right
        slope = np.concatenate(([off.sum()], z.T @ off + _SHRINK * parameters[1:]))
        square = 0.5 * _SHRINK * np.square(parameters[1:]).sum()
        return float((np.logaddexp(0, odds) - right * odds).sum() + square), slope

    # The joint's own weight is never 0, for the others are given in units of it.
    bounds = [(None, None), (0.05, None), (0, None), (0, None)]
    start = np.array([0.0, 1.0, 0.0, 0.0])
    found = minimize(loss, start, jac=True, bounds=bounds, method="L-BFGS-B").x[1:] / spread
    whole, behind = (round(float(weight / found[0]), 2) for weight in found[1:])
    score = signed @ (1, whole, behind)
    least = round(float(np.percentile(score[~tips.wrong], right_pct)), 2)
    return JointFlags(least, whole, behind)


def _score(tips: Tips, flags: JointFlags) -> np.ndarray:
    score: np.ndarray = tips.columns @ (1, flags.whole, -flags.behind)
    return score


def rates(tips: Tips, flags: JointFlags) -> dict[str, Any]:
    """Of the wrong and of the right tips: how many there are, and per cent that are flagged."""
    flagged = _score(tips, flags) < flags.least
    found: dict[str, Any] = {}
    for name, rows in (("wrong", tips.wrong), ("right", ~tips.wrong)):
        found[name] = int(rows.sum())
        found[f"{name}_flagged_pct"] = (
            round(100 * float(flagged[rows].mean()), 1) if rows.any() else None
        )
    return found


def curve(tips: Tips, flags: JointFlags) -> list[tuple[float, float]]:
    """Per cent of the right tips that other thresholds flag, and of the wrong ones."""
    score = _score(tips, flags)
    if not tips.wrong.any() or tips.wrong.all():
        return []
    points = []
    for right in _RATES:
        least = np.percentile(score[~tips.wrong], right)
        points.append((float(right), round(100 * float((score[tips.wrong] < least).mean()), 1)))
    return points


def lines(report: dict[str, Any]) -> list[str]:
    """For people; what is indented goes into conf/lost/calibrated.yaml."""
    said = [f"  {name}: {value:g}" for name, value in report["joint_ok"].items()]
    for where, words in (("chosen_on", "chosen on"), ("shown_on", "the other half")):
        of = report[where]
        said.append(
            f"{words}: {of['wrong_flagged_pct']} % of {of['wrong']} wrong tips flagged,"
            f" {of['right_flagged_pct']} % of {of['right']} right ones"
        )
    pairs = ", ".join(f"{wrong:g} at {right:g}" for right, wrong in report["curve"])
    return ["joint_ok:", *said, f"other thresholds there, wrong at right flagged, %: {pairs}"]


if __name__ == "__main__":
    sys.exit(command_line.run(main))
