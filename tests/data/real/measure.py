#!/usr/bin/env python3
"""How well the tracker follows the real recordings of this folder.

    python tests/data/real/measure.py RECORDING.npz [...] [--json FILE] [KEY=VALUE ...]

RECORDING.npz is what make_extract.py makes. Of a recording with the truth of every joint: usable
and silently wrong frames, without the first two joints, which mean other places there; of frames
that are not lost, those with all visible tips within 40 mm, and those with one that is farther off
and ok. A tip is visible where nothing is seen more than 25 mm before it. Of single images, each
shown to a new tracker for ten frames: what each is called. Of others: how many frames are lost.
Where the recording's folder has labels.json, visible fingertips that were labelled by eye, also
what `toftrack benchmark accuracy --labels` tells of them.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.api import make_hands_tracker
from toftrack.evaluation.image_labels import Points, point_rows, read_labels
from toftrack.evaluation.results import circumstances
from toftrack.evaluation.trust import OK_MM, TIPS, judged, trust
from toftrack.frames.frame import Truth
from toftrack.training.fit_confidence import reliability_figure
from toftrack.views.pictures import write_picture

_JOINTS = slice(2, None)
_BEFORE_M = 0.025
_EDGES = (0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0001)
_SHOWN_FRAMES = 10
_SEVERAL = 20
"""Recordings with labels or fewer frames are single images."""


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="+", metavar="RECORDING.npz")
    parser.add_argument("--side", default="right", help="right, left or auto (right)")
    parser.add_argument("--seed", default="0", help="of the tracker (0)")
    parser.add_argument("--json", type=Path, help="what was measured of each recording")
    parser.add_argument("--picture", type=Path, help="how often joints of a confidence are right")
    asked = parser.parse_args()
    paths = [Path(one) for one in asked.recordings if "=" not in one]
    overrides = [one for one in asked.recordings if "=" in one]
    settings = [f"hand.side={asked.side}", f"seed={asked.seed}", *overrides]
    rows: dict[str, Any] = {}
    sure, right = [], []
    for path in paths:
        with np.load(path, allow_pickle=False) as file:
            kept = {name: file[name] for name in file.files}
        if "joints_m" in kept:
            rows[path.stem], said, near = _with_truth(kept, settings)
            sure.append(said)
            right.append(near)
        elif "labels" in kept or len(kept["depth_m"]) < _SEVERAL:
            rows[path.stem] = _images(path.stem, kept, settings)
        else:
            said = _tracked(kept, settings)
            rows[path.stem] = {"frames": len(said), "flagged": sum(one.lost for one in said)}
            rows[path.stem] |= _labelled(path.stem, kept, said)
        print(f"{path.stem}:", json.dumps(rows[path.stem]))
    if sure:
        reliability = np.concatenate(sure), np.concatenate(right)
        _print_reliability(*reliability)
        if asked.picture is not None:
            write_picture(asked.picture, reliability_figure(*reliability, "joints"))
    if asked.json is not None:
        about = circumstances() | {"seed": int(asked.seed), "side": asked.side}
        written = json.dumps({"about": about, "rows": rows}, indent=1)
        asked.json.write_text(written + "\n", encoding="utf-8")


def _tracked(kept: dict[str, np.ndarray], settings: list[str]) -> list[Any]:
    tracker, k = make_hands_tracker(*settings), kept["K"].astype(float)
    fps = float(kept["fps"])
    return [tracker.step(image, k, n, n / fps)[0] for n, image in enumerate(kept["depth_m"])]


def _with_truth(
    kept: dict[str, np.ndarray], settings: list[str]
) -> tuple[dict[str, float], np.ndarray, np.ndarray]:
    """The figures; of each joint of the frames that are not lost its confidence, and whether it is
    right."""
    said, joints = _tracked(kept, settings), kept["joints_m"].astype(float)
    lost = np.array([one.lost for one in said])
    estimated = np.array([one.joints_m for one in said])
    every = np.ones(len(joints), bool)
    of = judged(estimated[:, _JOINTS], lost, Truth(joints[:, _JOINTS], every, every))
    found, wrong = trust(of), of.error_mm > OK_MM
    ok = np.array([one.joint_ok for one in said])
    tips = list(TIPS)
    off_mm = 1e3 * np.linalg.norm(estimated - joints, axis=2)[:, tips]
    tips_wrong = (off_mm > OK_MM) & _visible(joints[:, tips], kept["depth_m"], kept["K"])
    figures = {
        "frames": len(said),
        "flagged": int(lost.sum()),
        "usable_pct": found.usable_pct,
        "silent_pct": found.silent_pct,
        "mean_mm": found.mean_mm or 0.0,
        "tips_40_pct": 100 * float((~tips_wrong.any(1))[~lost].mean()),
        "tips_wrong_ok_pct": 100 * float((tips_wrong & ok[:, tips]).any(1)[~lost].mean()),
        "wrong_joints": int(wrong[~lost].sum()),
        "wrong_ok_pct": 100 * float(ok[~lost][:, _JOINTS][wrong[~lost]].mean()),
        "right_not_ok_pct": 100 * float((~ok[~lost][:, _JOINTS][~wrong[~lost]]).mean()),
    }
    confidence = np.array([one.joint_confidence for one in said])[:, _JOINTS]
    figures = {name: round(value, 2) for name, value in figures.items()}
    return figures, confidence[~lost].ravel(), ~wrong[~lost].ravel()


def _visible(points_m: np.ndarray, depth_m: np.ndarray, k: np.ndarray) -> np.ndarray:
    """(T, P) whether nothing is seen before points (T, P, 3), which must be in the image."""
    at = points_m[..., :2] / points_m[..., 2:] * np.diag(k)[:2] + k[:2, 2]
    column, row = np.moveaxis(np.rint(at).astype(int), -1, 0)
    height, width = depth_m.shape[1:]
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    frame = np.arange(len(depth_m))[:, None]
    seen = depth_m[frame, np.where(inside, row, 0), np.where(inside, column, 0)]
    visible: np.ndarray = inside & ((seen == 0) | (seen > points_m[..., 2] - _BEFORE_M))
    return visible


def _labelled(name: str, kept: dict[str, np.ndarray], said: list[Any]) -> dict[str, float]:
    """What is told of the labels of a recording or of single images; nothing where it has none."""
    file = Path(__file__).parent / name / "labels.json"
    if not file.exists():
        return {}
    labels = read_labels(file)
    assert isinstance(labels, Points)
    fields = ("joints_m", "lost", "joint_ok")
    columns = [np.array([getattr(one, field) for one in said]) for field in fields]
    rows = list(point_rows(labels, *columns, kept["K"].astype(float)).values())
    names = [name for name in rows[0] if isinstance(rows[0][name], (int, float))]
    return {"labelled": len(rows)} | {
        name: round(float(np.mean([row[name] for row in rows])), 2) for name in names
    }


def _images(name: str, kept: dict[str, np.ndarray], settings: list[str]) -> dict[str, Any]:
    called, settings = [], [*settings, "hand.side=auto"]  # nobody says whose hand each shows
    said = []
    for number, image in enumerate(kept["depth_m"]):
        tracker = make_hands_tracker(*settings)
        for index in range(_SHOWN_FRAMES):
            one = tracker.step(image, kept["K"].astype(float), index, index / 25)[0]
        said.append(one)
        shown = str(kept["labels"][number]) if "labels" in kept else "-"
        called.append(f"{shown}: {'lost' if one.lost else one.gesture or '-'}")
    return {"images": len(called), "called": called} | _labelled(name, kept, said)


def _print_reliability(said: np.ndarray, right: np.ndarray) -> None:
    print("joint_confidence, mean: joints within 40 mm, of how many")
    for low, high in zip(_EDGES[:-1], _EDGES[1:], strict=True):
        rows = (said >= low) & (said < high)
        if rows.any():
            print(f"  {said[rows].mean():.3f}: {right[rows].mean():.3f} of {rows.sum()}")


if __name__ == "__main__":
    main()
