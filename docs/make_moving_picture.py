#!/usr/bin/env python3
"""Makes docs/tracked.webp, the moving picture of README.md: two samples while they are tracked.

    python docs/make_moving_picture.py

The depth images in colours (near is red), with the estimated joints; side by side. Needs the
encoder `libwebp_anim`, which wheels of the package `av` have.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np

import toftrack
from toftrack.devices.replay import Sample
from toftrack.views.skeleton import draw_hands

MADE = Path(__file__).parent / "tracked.webp"
SAMPLES = ("right_hand", "left_hand")
FRAMES, FPS = 80, 25
SCALE = 2.25
"""Pixels of the picture for one of the image."""
LARGEST_MB = 2.0
QUALITY = 55
NEAR_M, FAR_M = 0.35, 1.2
"""Depths of the first and the last colour."""


def coloured(depth_m: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8 BGR; nothing read is black. Noise is smoothed: it would fill the file."""
    share = np.clip((FAR_M - depth_m) / (FAR_M - NEAR_M), 0, 1)
    grey = cv2.medianBlur(np.rint(255 * share).astype(np.uint8), 5)
    picture = cv2.applyColorMap(grey, cv2.COLORMAP_TURBO)
    picture[cv2.medianBlur((depth_m > 0).astype(np.uint8), 5) == 0] = 0
    height, width = (2 * round(SCALE * size / 2) for size in depth_m.shape)
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_LINEAR)


def tracked(name: str) -> Iterator[np.ndarray]:
    """The pictures of a sample."""
    tracker = toftrack.make_tracker("seed=0")
    with Sample(name=name, stop=FRAMES) as device:
        camera = device.camera
        for frame in device:
            depth_m = camera.rectify(frame.depth, frame.radial)
            estimate = tracker.step(depth_m, camera.K, frame.index, frame.timestamp_s)
            picture = coloured(depth_m)
            shares = picture.shape[1] / depth_m.shape[1], picture.shape[0] / depth_m.shape[0]
            draw_hands(picture, camera, [estimate], shares)
            yield picture


def main() -> None:
    with av.open(str(MADE), "w", options={"loop": "0"}) as file:
        stream = file.add_stream("libwebp_anim", rate=FPS)
        stream.pix_fmt, stream.options = "yuv420p", {"quality": str(QUALITY)}
        for index, pictures in enumerate(zip(*map(tracked, SAMPLES), strict=True)):
            whole = np.hstack(pictures)
            if index == 0:
                stream.height, stream.width = whole.shape[:2]
            for packet in stream.encode(av.VideoFrame.from_ndarray(whole, format="bgr24")):
                file.mux(packet)
        for packet in stream.encode():
            file.mux(packet)
    size_mb = MADE.stat().st_size / 1e6
    print(f"{MADE}: {size_mb:.2f} MB")
    if size_mb > LARGEST_MB:
        raise SystemExit(f"larger than {LARGEST_MB} MB; lower QUALITY or SCALE")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    main()
