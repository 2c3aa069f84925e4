"""Choose from which confidence on a joint may be used, `joint_ok`, on half of some recordings, and
show what it does on the other half.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from toftrack.api import make_tracker
from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.evaluation.image_labels import Points, lateral_errors_mm, read_labels
from toftrack.evaluation.trust import OK_MM, TIPS
from toftrack.frames.frame import Truth


@dataclass(frozen=True, eq=False)
class Tips:
    """N visible fingertips in frames that are not flagged lost.

    confidence: (N,) of each.  wrong: (N,) more than 40 mm off.
    shown: (N,) of a recording on which nothing is chosen.
    """

    confidence: np.ndarray
    wrong: np.ndarray
    shown: np.ndarray

    def half(self, shown: bool) -> Tips:
        """Those on which the flags are chosen, or those on which they are shown."""
        rows = self.shown == shown
        return Tips(self.confidence[rows], self.wrong[rows], self.shown[rows])


def fit_joint_flags(asked: argparse.Namespace) -> None:
    """Track, choose, report; asked: the arguments of fit-joint-flags. Raises ToftrackError."""
    if not 0 < asked.right < 100:
        raise ToftrackError(f"--right {asked.right:g} is no share; give per cent, as 4")
    labels = [read_points(path) for path in asked.labels]
    found = recordings(asked.recordings)
    todo = [(path, seed) for path in found for seed in range(1, asked.seeds + 1)]
    parts = [
        observed(path, labels, seed, is_shown(path, found), asked.settings)
        for path, seed in tqdm(todo, unit=" recordings", file=sys.stderr)
    ]
    columns = zip(*((part.confidence, part.wrong, part.shown) for part in parts), strict=True)
    tips = Tips(*map(np.concatenate, columns))
    # Both ways round: what halves of few recordings differ by is to be seen.
    reports = [report(tips, shown, asked.right) for shown in (True, False)]
    print("\n\nthe other way round\n".join(reports))


def report(tips: Tips, shown: bool, right_pct: float) -> str:
    """What is chosen on a half, and what it does there and on the one that is shown; the first line
    goes into conf/lost/calibrated.yaml.
    """
    least = chosen(tips.half(not shown), right_pct)
    lines = [f"joint_ok: {least:g}"]
    for words, half in (("chosen on", not shown), ("the other half", shown)):
        of = rates(tips.half(half), least)
        lines.append(
            f"{words}: {of['wrong_flagged_pct']} % of {of['wrong']} wrong tips flagged,"
            f" {of['right_flagged_pct']} % of {of['right']} right ones"
        )
    return "\n".join(lines)


def recordings(paths: list[str]) -> list[Path]:
    """The .npz files that are named, and those of folders in the order of their names."""
    found: list[Path] = []
    for path in (Path(name).expanduser() for name in paths):
        mine = sorted(path.glob("*.npz")) if path.is_dir() else [path]
        if not mine:
            raise ToftrackError(f"the folder '{path}' has no .npz; give one with recordings")
        found += mine
    return found


def read_points(path: str) -> Points:
    """Labels of points; ToftrackError for others."""
    labels = read_labels(path)
    if not isinstance(labels, Points):
        raise ToftrackError(f"'{path}' labels no points; give labels of fingertips")
    return labels


def is_shown(path: Path, found: list[Path]) -> bool:
    """Whether nothing is chosen on a recording: every second one of its folder."""
    return [one for one in found if one.parent == path.parent].index(path) % 2 == 1


def observed(path: Path, labels: list[Points], seed: int, shown: bool, settings: list[str]) -> Tips:
    """The fingertips of a recording with truth, or else with labels of images of its size.

    shown: as in Tips.
    """
    with Replay(path) as device:
        k, size = device.camera.K, (device.camera.width, device.camera.height)
        known = device.truth or next((one for one in labels if one.size == size), None)
        if known is None:
            raise ToftrackError(
                f"'{path}' has no truth, and no labels fit it; give --labels, or leave it out"
            )
        if known.side not in ("right", "left"):
            raise ToftrackError(f"'{path}' does not say whose hand it shows; leave it out")
        side = known.side
        tracker = make_tracker(f"hand.side={side}", f"seed={seed}", *settings)
        joints, sure = [], []
        for frame in device:
            depth = device.camera.rectify(frame.depth, frame.radial)
            estimate = tracker.step(depth, k, frame.index, frame.timestamp_s)
            joints.append(estimate.joints_m)
            sure.append(np.where(estimate.lost, np.nan, estimate.joint_confidence))
    off = _tips_off_mm(np.array(joints), known, k)
    of_tips = np.array(sure)[:, TIPS]
    used = np.isfinite(off) & np.isfinite(of_tips)
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


def chosen(tips: Tips, right_pct: float) -> float:
    """The confidence below which so many per cent of the right tips are."""
    if tips.wrong.all():
        raise ToftrackError(
            "no fingertip of the half on which is chosen is right: give more recordings, or others"
        )
    return float(np.percentile(tips.confidence[~tips.wrong], right_pct).round(4))


def rates(tips: Tips, least: float) -> dict[str, Any]:
    """Of the wrong and of the right tips: how many there are, and per cent that are flagged."""
    flagged = tips.confidence < least
    found: dict[str, Any] = {}
    for name, rows in (("wrong", tips.wrong), ("right", ~tips.wrong)):
        found[name] = int(rows.sum())
        found[f"{name}_flagged_pct"] = (
            round(100 * float(flagged[rows].mean()), 1) if rows.any() else None
        )
    return found
