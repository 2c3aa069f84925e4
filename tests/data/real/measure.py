#!/usr/bin/env python3
"""How well the tracker follows the real recordings of this folder.

    python tests/data/real/measure.py RECORDING.npz [...] [--picture FILE] [KEY=VALUE ...]

RECORDING.npz is what make_extract.py makes. Of a recording with the truth of every
joint: usable and silently wrong frames, wrong joints that are not ok, and how often joints are
right by what is said of them; without the first two joints, which mean other places there. Of one
without truth: how many frames are lost, and how sure the others are.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from toftrack.api import make_hands_tracker
from toftrack.evaluation.trust import OK_MM, judged, trust
from toftrack.frames.frame import Truth
from toftrack.training.fit_confidence import reliability_figure
from toftrack.views.pictures import write_picture

_JOINTS = slice(2, None)
_EDGES = (0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0001)


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="+", metavar="RECORDING.npz")
    parser.add_argument("--side", default="right", help="right, left or auto (right)")
    parser.add_argument("--seed", default="0", help="of the tracker (0)")
    parser.add_argument("--picture", type=Path, help="how often joints of a confidence are right")
    asked = parser.parse_args()
    paths = [Path(one) for one in asked.recordings if "=" not in one]
    overrides = [one for one in asked.recordings if "=" in one]
    sure, right = [], []
    for path in paths:
        with np.load(path, allow_pickle=False) as file:
            depth, k, fps = file["depth_m"], file["K"].astype(float), float(file["fps"])
            joints = file["joints_m"].astype(float) if "joints_m" in file.files else None
        tracker = make_hands_tracker(f"hand.side={asked.side}", f"seed={asked.seed}", *overrides)
        said = [tracker.step(image, k, n, n / fps)[0] for n, image in enumerate(depth)]
        lost = np.array([one.lost for one in said])
        print(f"{path.stem}: {len(said)} frames, {lost.sum()} lost", end="")
        if joints is None:
            confidence = [one.confidence for one in said if not one.lost] or [np.nan]
            quartiles = np.percentile(confidence, (25, 50, 75))
            print("; confidence of the others, quartiles:", *(f"{one:.2f}" for one in quartiles))
            continue
        every = np.ones(len(joints), bool)
        truth = Truth(joints[:, _JOINTS], every, every)
        of = judged(np.array([one.joints_m for one in said])[:, _JOINTS], lost, truth)
        found, wrong = trust(of), of.error_mm > OK_MM
        ok = np.array([one.joint_ok for one in said])[:, _JOINTS]
        print(
            f"; usable {found.usable_pct:.1f} %, silently wrong {found.silent_pct:.1f} %, mean"
            f" {found.mean_mm:.1f} mm; of joints in frames that are not lost {wrong[~lost].sum()}"
            f" wrong, {100 * ok[~lost][wrong[~lost]].mean():.0f} % of them ok; of the right ones"
            f" {100 * (~ok[~lost][~wrong[~lost]]).mean():.1f} % not ok"
        )
        confidence = np.array([one.joint_confidence for one in said])[:, _JOINTS]
        sure.append(confidence[~lost].ravel())
        right.append(~wrong[~lost].ravel())
    if sure:
        _print_reliability(np.concatenate(sure), np.concatenate(right))
        if asked.picture is not None:
            of = (np.concatenate(sure), np.concatenate(right), "joints")
            write_picture(asked.picture, reliability_figure(*of))


def _print_reliability(said: np.ndarray, right: np.ndarray) -> None:
    print("joint_confidence, mean: joints within 40 mm, of how many")
    for low, high in zip(_EDGES[:-1], _EDGES[1:], strict=True):
        rows = (said >= low) & (said < high)
        if rows.any():
            print(f"  {said[rows].mean():.3f}: {right[rows].mean():.3f} of {rows.sum()}")


if __name__ == "__main__":
    main()
