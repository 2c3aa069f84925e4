#!/usr/bin/env python3
"""How far joint angles are off, in degrees, as a table of Markdown: docs/accuracy.md has one.

    python docs/measure_angles.py FOLDER...      every .npz in it whose truth has joints and a side

Truth has joints, not angles, and so the angle between the two bones that meet at a joint is taken
of both, estimate and truth; it is 0 where the finger is straight. At the PIP and DIP joints, and at
the thumb's IP, it is the flexion in track.npz without its sign; elsewhere it holds some abduction,
too. An angle counts in frames that are visible and not lost, where the joint and both its
neighbours are ok. A cell is the mean absolute error, the 90th percentile in brackets, and the mean
of estimate minus truth.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

import toftrack

FINGERS = ("thumb", "index", "middle", "ring", "little")


def bent_deg(joints_m: np.ndarray) -> np.ndarray:
    """(T, 5, 3) angles between the bones at the three inner joints of each finger of (T, 21, 3)."""
    wrist = np.broadcast_to(joints_m[:, None, :1], (len(joints_m), 5, 1, 3))
    chain = np.concatenate((wrist, joints_m[:, 1:].reshape(-1, 5, 4, 3)), 2)
    bones = np.diff(chain, axis=2)
    bones /= np.linalg.norm(bones, axis=-1, keepdims=True)
    return np.degrees(np.arccos((bones[:, :, 1:] * bones[:, :, :-1]).sum(-1).clip(-1, 1)))


def every_neighbour(of_joints: np.ndarray) -> np.ndarray:
    """(T, 5, 3) of (T, 21): whether all three joints that make an angle are so."""
    chain = np.concatenate(
        (np.repeat(of_joints[:, None, :1], 5, 1), of_joints[:, 1:].reshape(-1, 5, 4)), 2
    )
    return chain[:, :, 2:] & chain[:, :, 1:-1] & chain[:, :, :-2]


def measured(path: Path) -> tuple[np.ndarray, ...] | None:
    """Of a recording's visible frames that are not lost (T, 5, 3): errors and true angles, degrees,
    whether the joints of each are ok, and whether they have a confidence of 0.95; None without
    truth."""
    with np.load(path) as recording:
        if "joints_m" not in recording or "metadata" not in recording:
            return None
        true_m, visible = recording["joints_m"], recording["visible"]
        side = json.loads(str(recording["metadata"])).get("side")
    found = toftrack.track(str(path), f"hand.side={side or 'auto'}").results()
    used = visible & ~found.lost
    true_deg = bent_deg(true_m[used])
    error = bent_deg(found.joints_m[used]) - true_deg
    sure = found.joint_confidence[used] >= 0.95
    return error, true_deg, every_neighbour(found.joint_ok[used]), every_neighbour(sure)


def cell(error: np.ndarray) -> str:
    if not error.size:
        return "-"
    off = np.abs(error)
    return f"{off.mean():.1f} ({np.percentile(off, 90):.0f}), {error.mean():+.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    paths = [file for at in parser.parse_args().folders for file in sorted(at.glob("*.npz"))]
    parts = [part for part in map(measured, paths) if part is not None]
    if not parts:
        raise SystemExit("error: no .npz there has joints_m and metadata; give folders with truth")
    error, true_deg, ok, sure = (np.concatenate(pieces) for pieces in zip(*parts, strict=True))
    print(f"{len(parts)} recordings, {len(error)} frames; {100 * ok.mean():.0f} % of the angles")
    print(f"are ok, {100 * sure.mean():.0f} % of all have a confidence of 0.95\n")
    print("| | MCP (thumb: CMC) | PIP (thumb: MCP) | DIP (thumb: IP) |\n| --- | --- | --- | --- |")
    for number, finger in enumerate(FINGERS):
        cells = [cell(error[:, number, joint][ok[:, number, joint]]) for joint in range(3)]
        print(f"| {finger} | {' | '.join(cells)} |")
    rows = {
        "the four fingers": ok,
        "... of a `joint_confidence` of 0.95 and more": sure,
        "... not ok": ~ok,
        "... ok, truly bent by less than 30 degrees": ok & (true_deg < 30),
        "... ok, 30 to 90": ok & (true_deg >= 30) & (true_deg < 90),
        "... ok, 90 and more": ok & (true_deg >= 90),
    }
    for name, chosen in rows.items():
        cells = [cell(error[:, 1:, joint][chosen[:, 1:, joint]]) for joint in range(3)]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
