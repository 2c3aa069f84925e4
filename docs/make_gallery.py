#!/usr/bin/env python3
"""Makes the pictures of docs/gallery.md, docs/gallery/*.webp: python docs/make_gallery.py [NAME ...]

Each is a frame of a recording that lies in this repository, all drawn and all CC0, tracked from its
beginning with the tracker's own settings: the depth image in colours (near is red), with the
estimated joints. Prints the mean and the largest error of each.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

import toftrack

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs"))
from make_moving_picture import coloured  # noqa: E402

from toftrack.views.skeleton import draw_hands  # noqa: E402

STRANGERS = "tests/data/strangers"
PICTURES = {
    "counting": (f"{STRANGERS}/02_count_near", 22, 1),
    "at_camera": (f"{STRANGERS}/04_point_at_camera", 40, 1),
}
"""Of each picture its recording, its frame, and how many hands are followed."""
WIDTH, QUALITY = 396, 80


def picture(recording: str, number: int, hands: int) -> tuple[np.ndarray, str]:
    """(h, w, 3) uint8 BGR of a frame, and what is printed of it."""
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
    draw_hands(drawn, camera, estimates, (drawn.shape[1] / camera.width,) * 2)
    first = estimates[0]
    away_mm = 1000 * np.linalg.norm(first.joints_m - truth.joints_m[number - truth.first], axis=1)
    return drawn, (
        f"mean {away_mm.mean():.0f} mm, largest {away_mm.max():.0f} mm, confidence "
        f"{first.confidence:.2f}, {first.state_name}, lost {first.lost}, {first.gesture}"
    )


def main(names: list[str]) -> None:
    for name in names or PICTURES:
        drawn, said = picture(*PICTURES[name])
        made = ROOT / "docs" / "gallery" / f"{name}.webp"
        made.parent.mkdir(exist_ok=True)
        made.write_bytes(cv2.imencode(".webp", drawn, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])[1])
        print(f"{made.name}: {said}")


if __name__ == "__main__":
    main(sys.argv[1:])
