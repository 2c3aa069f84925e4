#!/usr/bin/env python3
"""What each property of an image costs the pose network: keypoints at the true middle of the palm.

    python tests/tools/properties.py RECORDING.npz [...] [--every 8] [--weights detector.npz]

RECORDING.npz has depth_m, K and joints_m (docs/formats.md). Each property is put into every
chosen frame, one at a time. Printed is a table in Markdown, docs/real_images.md has it: drawn
images get what real ones have (noise, missing edges, ...), real ones lose it (smoothed, no arm).
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from toftrack.api import make_hands_tracker
from toftrack.detector.crops import thinned
from toftrack.detector.flying_pixels import without_flying_pixels

_JUMP_M = 0.03
"""Neighbouring readings that differ by more are an edge."""
_NEAR_M = 0.12
"""Farther from the palm's depth nothing is of the hand."""
_RIGHT_MM, _SURE_MM = 40, 20
"""A keypoint is right within, and sure with a deviation below."""


@dataclass
class Frame:
    """An image, its camera, and where the hand is; what a property changes."""

    depth_m: np.ndarray
    k: np.ndarray
    joints_m: np.ndarray
    rng: np.random.Generator

    @property
    def palm_m(self) -> np.ndarray:
        up = self.joints_m[9] - self.joints_m[0]
        middle = self.joints_m[[5, 9, 13, 17]].mean(0) - 0.035 * up / np.linalg.norm(up)
        return np.asarray(middle)

    @property
    def of_hand(self) -> np.ndarray:
        """(H, W) readings about as far away as the palm."""
        return (self.depth_m > 0) & (np.abs(self.depth_m - self.palm_m[2]) < _NEAR_M)

    def ray_points(self) -> np.ndarray:
        """(H, W, 3) of each reading."""
        v, u = np.indices(self.depth_m.shape)
        x = (u - self.k[0, 2]) / self.k[0, 0] * self.depth_m
        y = (v - self.k[1, 2]) / self.k[1, 1] * self.depth_m
        return np.stack((x, y, self.depth_m), -1)


def _filled(depth: np.ndarray, far: float = 4.0) -> np.ndarray:
    return np.where(depth > 0, depth, np.float32(far)).astype(np.float32)


def _edges(depth: np.ndarray, size: int) -> np.ndarray:
    full = _filled(depth)
    window = np.ones((size, size), np.uint8)
    return cv2.dilate(full, window) - cv2.erode(full, window) > _JUMP_M


def noise(f: Frame, sigma_m: float) -> None:
    some = f.rng.normal(0, sigma_m, f.depth_m.shape).astype(np.float32)
    f.depth_m = np.where(f.depth_m > 0, f.depth_m + some, 0)


def waves(f: Frame, sigma_m: float, scale_px: float) -> None:
    field = f.rng.normal(0, 1, f.depth_m.shape).astype(np.float32)
    field = cv2.GaussianBlur(field, (0, 0), scale_px)
    f.depth_m = np.where(f.depth_m > 0, f.depth_m + sigma_m * field / field.std(), 0)


def steps(f: Frame, step_m: float) -> None:
    f.depth_m = np.round(f.depth_m / step_m).astype(np.float32) * np.float32(step_m)


def holes(f: Frame, share: float, size: int = 1) -> None:
    h, w = f.depth_m.shape
    small = f.rng.random((h // size + 1, w // size + 1)) < share
    f.depth_m = np.where(np.kron(small, np.ones((size, size)))[:h, :w] > 0, 0, f.depth_m)


def edges_lost(f: Frame, size: int) -> None:
    f.depth_m = np.where(_edges(f.depth_m, size), 0, f.depth_m)


def fat(f: Frame, size: int) -> None:
    near = cv2.erode(_filled(f.depth_m), np.ones((size, size), np.uint8))
    f.depth_m = np.where(near < 3.9, near, 0)


def shadows(f: Frame, base_m: float) -> None:
    """Structured light: what the projector, `base_m` to the right, does not see."""
    depth = _filled(f.depth_m)
    h, w = depth.shape
    disparity = f.k[0, 0] * base_m / depth
    # From the side of the projector on, a reading is seen if no nearer one covers its column.
    target = np.arange(w)[None] - disparity
    nearest = np.minimum.accumulate(target[:, ::-1], axis=1)[:, ::-1]
    f.depth_m = np.where(target > np.roll(nearest, -1, 1) + 0.5, 0, f.depth_m)
    f.depth_m[:, -1] = 0


def flying(f: Frame, size: int) -> None:
    full = _filled(f.depth_m, 2.0)
    window = np.ones((size, size), np.uint8)
    near, far = cv2.erode(full, window), cv2.dilate(full, window)
    part = f.rng.random(full.shape) ** 2
    mixed = near + part * np.minimum(far - near, 0.6)
    f.depth_m = np.where(_edges(f.depth_m, size), mixed, f.depth_m)


def smoothed(f: Frame, size: int) -> None:
    kept = cv2.bilateralFilter(_filled(f.depth_m), size, 0.025, size / 2)
    f.depth_m = np.where(f.depth_m > 0, kept, 0)


def median(f: Frame, size: int) -> None:
    f.depth_m = cv2.medianBlur(f.depth_m.astype(np.float32), size)


def closed(f: Frame, size: int) -> None:
    """Small holes are filled with what is behind them."""
    filled = cv2.dilate(f.depth_m.astype(np.float32), np.ones((size, size), np.uint8))
    f.depth_m = np.where(f.depth_m > 0, f.depth_m, filled)


def hollows(f: Frame, factor: float) -> None:
    size = int(0.05 * f.k[0, 0] / f.palm_m[2]) | 1
    ring = np.where(f.of_hand, f.depth_m, 9).astype(np.float32)
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    front = cv2.dilate(cv2.erode(ring, window), window)  # opening: hollows are closed
    deep = np.where(f.of_hand, np.clip(f.depth_m - front, 0, 0.05), 0)
    f.depth_m = (f.depth_m + (factor - 1) * deep).astype(np.float32)


def relief(f: Frame, factor: float) -> None:
    middle = f.palm_m[2]
    f.depth_m = np.where(f.of_hand, middle + factor * (f.depth_m - middle), f.depth_m)


def sized(f: Frame, factor: float) -> None:
    """A smaller or larger hand: all of the world is, and stands as far away in proportion."""
    f.depth_m, f.joints_m = f.depth_m * factor, f.joints_m * factor


def resolved(f: Frame, factor: float) -> None:
    h, w = (int(side * factor) for side in f.depth_m.shape)
    f.depth_m = cv2.resize(f.depth_m, (w, h), interpolation=cv2.INTER_NEAREST)
    f.k = f.k.copy()
    f.k[:2] *= factor


def grazing(f: Frame, degrees: float) -> None:
    """Surfaces that are seen at more than this angle give no reading."""
    points = cv2.GaussianBlur(f.ray_points().astype(np.float32), (0, 0), 0.8)
    du, dv = np.gradient(points, axis=1), np.gradient(points, axis=0)
    normal = np.cross(du, dv)
    ray = points / np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-9)
    cosine = np.abs((normal * ray).sum(-1)) / np.maximum(np.linalg.norm(normal, axis=-1), 1e-12)
    f.depth_m = np.where(cosine < np.cos(np.radians(degrees)), 0, f.depth_m)


def _arm_way(f: Frame) -> tuple[np.ndarray, np.ndarray]:
    """How far along the forearm each reading lies beyond the wrist, and how far from its axis."""
    wrist = f.joints_m[0]
    down = wrist - f.joints_m[9]
    down = down / np.linalg.norm(down)
    off = f.ray_points() - wrist
    along = off @ down
    return along, np.linalg.norm(off - along[..., None] * down, axis=-1)


def without_arm(f: Frame) -> None:
    along, across = _arm_way(f)
    f.depth_m = np.where((along > 0.03) & (across < 0.09), 0, f.depth_m)


def band(f: Frame, nearer_m: float) -> None:
    """A watch or cuff on the wrist: nearer by so much, or without a reading (NaN)."""
    along, across = _arm_way(f)
    on = (along > 0.01) & (along < 0.05) & (across < 0.06) & (f.depth_m > 0)
    f.depth_m = np.where(on, np.nan_to_num(f.depth_m - nearer_m), f.depth_m)


def sleeve(f: Frame, thick_m: float) -> None:
    """Cloth about the forearm from 2 cm beyond the wrist on, by fattening it."""
    along, across = _arm_way(f)
    arm = (along > 0.02) & (across < 0.07) & (f.depth_m > 0)
    size = max(int(2 * thick_m * f.k[0, 0] / f.palm_m[2]) | 1, 3)
    only = np.where(arm, f.depth_m - np.float32(0.6 * thick_m), 9).astype(np.float32)
    cloth = cv2.erode(only, np.ones((size, size), np.uint8))
    f.depth_m = np.where(
        (cloth < 8) & (along > 0), np.minimum(_filled(f.depth_m), cloth), f.depth_m
    )


def behind(f: Frame, gap_m: float | None) -> None:
    """A wall so far behind the hand's farthest joint; None = nothing is read there."""
    if gap_m is None:
        f.depth_m = np.where(f.depth_m > f.joints_m[:, 2].max() + 0.04, 0, f.depth_m)
        return
    wall = np.float32(f.joints_m[:, 2].max() + gap_m)
    f.depth_m = np.minimum(_filled(f.depth_m), wall)


def radial(f: Frame) -> None:
    """Distances along rays taken for Z: what a wrong setting does."""
    points = f.ray_points()
    f.depth_m = np.where(f.depth_m > 0, np.linalg.norm(points, axis=-1), 0)


def focal(f: Frame, factor: float) -> None:
    """A focal length that is wrong by a factor; the truth moves along."""
    f.k = f.k.copy()
    f.k[0, 0] *= factor
    f.k[1, 1] *= factor
    f.joints_m = f.joints_m / np.array([factor, factor, 1])


PROPERTIES: dict[str, tuple[Any, ...]] = {
    "as it is": (lambda f: None,),
    "noise of 3 mm": (noise, 0.003),
    "noise of 6 mm": (noise, 0.006),
    "noise of 12 mm": (noise, 0.012),
    "waves of 4 mm, 3 px wide": (waves, 0.004, 3),
    "waves of 8 mm, 6 px wide": (waves, 0.008, 6),
    "steps of 5 mm": (steps, 0.005),
    "steps of 10 mm": (steps, 0.010),
    "steps of 20 mm": (steps, 0.020),
    "1 in 10 readings missing": (holes, 0.1),
    "3 in 10 readings missing": (holes, 0.3),
    "1 in 10 patches of 3 px missing": (holes, 0.1, 3),
    "edges of 1 px missing": (edges_lost, 3),
    "edges of 2 px missing": (edges_lost, 5),
    "edges 1 px fatter": (fat, 3),
    "edges 2 px fatter": (fat, 5),
    "shadows, base of 50 mm": (shadows, 0.05),
    "flying pixels, 1 px": (flying, 3),
    "flying pixels, 2 px": (flying, 5),
    "smoothed, 5 px": (smoothed, 5),
    "smoothed, 9 px": (smoothed, 9),
    "median of 3 px": (median, 3),
    "median of 5 px": (median, 5),
    "holes of 2 px filled": (closed, 5),
    "hollows 0.5 as deep": (hollows, 0.5),
    "hollows 1.5 as deep": (hollows, 1.5),
    "hollows 2 times as deep": (hollows, 2.0),
    "relief 0.7 as deep": (relief, 0.7),
    "relief 1.4 as deep": (relief, 1.4),
    "hand 0.8 as large": (sized, 0.8),
    "hand 0.9 as large": (sized, 0.9),
    "hand 1.1 as large": (sized, 1.1),
    "hand 1.2 as large": (sized, 1.2),
    "half the resolution": (resolved, 0.5),
    "twice the resolution": (resolved, 2.0),
    "no reading beyond 60 degrees": (grazing, 60),
    "no reading beyond 75 degrees": (grazing, 75),
    "no forearm": (without_arm,),
    "a watch, 8 mm high": (band, 0.008),
    "a watch without readings": (band, float("nan")),
    "a sleeve of 12 mm": (sleeve, 0.012),
    "a wall 3 cm behind": (behind, 0.03),
    "nothing read behind": (behind, None),
    "distance taken for Z": (radial,),
    "focal length 5 % too short": (focal, 0.95),
    "focal length 10 % too long": (focal, 1.1),
}
"""Of each what changes a frame, and the numbers that it is given."""


def keypoints(
    path: str, every: int, weights: str | None
) -> dict[str, list[tuple[np.ndarray, np.ndarray, float]]]:
    """Of each property, a row a frame: the errors of the joints but the first two (which mean other
    places in some truths) and the deviations that are said, mm, and the probability of a hand.
    """
    torch.set_num_threads(1)
    given = [] if weights is None else [f"detector.weights={weights}"]
    detector = make_hands_tracker(*given).model.detector
    with np.load(path, allow_pickle=False) as file:
        depth, k, joints = file["depth_m"], file["K"].astype(float), file["joints_m"].astype(float)
        side = json.loads(str(file["metadata"]))["side"] if "metadata" in file else "right"
        seen = file["visible_fraction"] if "visible_fraction" in file else np.ones(len(depth))
    rows: dict[str, list] = {name: [] for name in PROPERTIES}
    for n in range(0, len(depth), every):
        for name, (change, *numbers) in PROPERTIES.items() if seen[n] > 0.7 else ():
            f = Frame(depth[n].astype(np.float32), k, joints[n], np.random.default_rng(n))
            change(f, *numbers)
            depth_m, of_image = thinned(f.depth_m, f.k)
            image = without_flying_pixels(depth_m, of_image, detector.settings.flying)
            up = f.joints_m[9] - f.joints_m[0]
            (first,) = detector.detect(image, of_image, f.palm_m[None], side, up[None])
            centre = first.centre_m.numpy()[None]
            (said,) = detector.detect(image, f.k, centre, side, first.up[None])
            off = np.linalg.norm(said.keypoints.points_m.numpy() - f.joints_m, axis=1)
            sigma = said.keypoints.sigma_m.numpy()
            rows[name].append((1e3 * off[2:], 1e3 * sigma[2:], said.present))
    return rows


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="+", metavar="RECORDING.npz")
    parser.add_argument("--every", type=int, default=8, help="only every so manieth frame (8)")
    parser.add_argument("--weights", help="other weights than the package's")
    asked = parser.parse_args()
    with ProcessPoolExecutor() as pool:
        count = len(asked.recordings)
        parts = list(
            pool.map(keypoints, asked.recordings, [asked.every] * count, [asked.weights] * count)
        )
    print(f"{sum(len(part['as it is']) for part in parts)} frames\n")
    print(
        "| | mean, mm | joints < 40 mm | frames, all < 40 mm | said, mm | wrong and sure | hand |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in PROPERTIES:
        rows = [row for part in parts for row in part[name]]
        off, sigma, present = map(np.array, zip(*rows, strict=True))
        right, sure = off < _RIGHT_MM, sigma < _SURE_MM
        print(
            f"| {name} | {off.mean():.1f} | {100 * right.mean():.1f} %"
            f" | {100 * right.all(1).mean():.1f} % | {sigma.mean():.1f}"
            f" | {100 * (~right & sure).mean():.1f} % | {present.mean():.2f} |"
        )


if __name__ == "__main__":
    main()
