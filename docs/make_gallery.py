#!/usr/bin/env python3
"""Makes the pictures of docs/gallery.md: python docs/make_gallery.py [NAME ...]

Each, docs/gallery/NAME.webp, is a frame of a recording that lies in this repository; all are drawn
and CC0. It is tracked from its beginning with the tracker's own settings and shown as a depth image
in colours (near is red), with the estimated joints. Prints the errors and the flags of each.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

import toftrack

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs"))
from make_moving_picture import coloured  # noqa: E402

from toftrack.hand.skeleton import JOINT_PARENTS  # noqa: E402
from toftrack.views.skeleton import draw_hands  # noqa: E402

STRANGERS = "tests/data/strangers"
SAMPLES = "toftrack/data/sample"
PICTURES = {
    "counting": (f"{STRANGERS}/02_count_near", 22, 1),
    "at_the_camera": (f"{STRANGERS}/04_point_at_camera", 10, 1),
    "ok": (f"{STRANGERS}/11_ok_relaxed", 4, 1),
    "victory": (f"{STRANGERS}/08_object_passes", 58, 1),
    "two_hands": (f"{SAMPLES}_two_hands", 60, 2),
    "two_hands_near": (f"{STRANGERS}/10_hands_front", 10, 2),
    "glass": (f"{SAMPLES}_glass", 40, 1),
    "bottle": (f"{STRANGERS}/13_drink", 28, 1),
    "box": (f"{STRANGERS}/15_pick_up", 58, 1),
    "wrong_phone": (f"{STRANGERS}/14_phone", 58, 1),
    "wrong_from_the_head": (f"{STRANGERS}/16_ego_bare", 10, 1),
    "wrong_hidden": (f"{STRANGERS}/08_object_passes", 28, 1),
}
"""Of each picture its recording, its frame, and how many hands are followed. What is wrong has the
true joints beside the estimated ones, in white."""
WIDTH, QUALITY = 396, 80


def picture(recording: str, number: int, hands: int, wrong: bool) -> tuple[np.ndarray, str]:
    """(h, w, 3) uint8 BGR of a frame, with the truth where it is wrong; what is printed of it."""
    tracker = toftrack.make_hands_tracker("seed=0", f"hands={hands}")
    with toftrack.make_device("device=replay", f"device.path={ROOT / recording}.npz") as device:
        camera, truth = device.camera, device.truth
        for frame in device:
            depth_m = camera.rectify(frame.depth, frame.radial)
            estimates = tracker.step(depth_m, camera.K, frame.index, frame.timestamp_s)
            if frame.index == number:
                break
    drawn = coloured(depth_m)
    drawn = cv2.resize(drawn, (WIDTH, WIDTH * camera.height // camera.width))
    scale = drawn.shape[1] / camera.width
    draw_hands(drawn, camera, estimates, (scale, scale))
    first, true_m = estimates[0], truth.joints_m[number - truth.first]
    if wrong:
        ends = np.rint(scale * camera.project(true_m)).astype(int).tolist()
        for end, parent in zip(ends[1:], JOINT_PARENTS[1:], strict=True):
            cv2.line(drawn, end, ends[parent], (255, 255, 255), 2, cv2.LINE_AA)
    away_mm = 1000 * np.linalg.norm(first.joints_m - true_m, axis=1)
    off = away_mm > 40
    return drawn, (
        f"mean {away_mm.mean():.0f} mm, largest {away_mm.max():.0f} mm, {off.sum()} joints over "
        f"40 mm off, {(off & ~first.joint_ok).sum()} of them flagged, confidence "
        f"{first.confidence:.2f}, {first.state_name}, lost {first.lost}, {first.gesture}"
    )


def main(names: list[str]) -> None:
    for name in names or PICTURES:
        drawn, said = picture(*PICTURES[name], wrong=name.startswith("wrong"))
        made = ROOT / "docs" / "gallery" / f"{name}.webp"
        made.parent.mkdir(exist_ok=True)
        made.write_bytes(cv2.imencode(".webp", drawn, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])[1])
        print(f"{made.name}: {said}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(PICTURES))
    asked = parser.parse_args().names
    if unknown := [name for name in asked if name not in PICTURES]:
        parser.error(f"there is no picture {unknown[0]}; give one of {', '.join(PICTURES)}")
    main(asked)
