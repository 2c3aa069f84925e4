#!/usr/bin/env python3
"""Crops of hands in pairs: drawn beside the same with a property, or real beside drawn.

    python tests/tools/pairs.py DRAWN.npz [...] --properties OUT.png
    python tests/tools/pairs.py DRAWN.npz [...] --real REAL.npz [...] --out FOLDER

The first makes the figure of docs/real_images.md, with the costs of its table. The second writes
FOLDER/pairs_REAL.png: real hands, and those drawn ones whose keypoints, by the network, lie most
alike about the palm. Real images have no licence: the folder must lie outside this repository.
"""

import argparse
import re
from pathlib import Path

import cv2
import numpy as np
from properties import PROPERTIES, Frame

from toftrack.api import make_hands_tracker
from toftrack.detector.hand_detector import HandDetector
from toftrack.views.figures import chart

ROOT = Path(__file__).resolve().parents[2]
SHOWN = (
    "noise of 12 mm", "waves of 8 mm, 6 px wide", "steps of 20 mm", "3 in 10 readings missing",
    "edges of 2 px missing", "edges 2 px fatter", "flying pixels, 2 px", "shadows, base of 50 mm",
    "no reading beyond 60 degrees", "a sleeve of 12 mm", "relief 1.4 as deep", "smoothed, 9 px",
)  # fmt: skip
_OPEN = ("palm", "spread", "victory", "three", "ok", "point")
_PX, _SPAN_M, _NEAR_M, _SLOPE_M, _COLUMNS = 136, 0.26, 0.1, 0.008, 4
Hand = tuple[str, np.ndarray, np.ndarray]
"""Name, crop, and the keypoints (21, 3) about the palm, mm of a hand of 90 mm to the knuckles."""


def tile(depth_m: np.ndarray, k: np.ndarray, palm_m: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """The BGR crop about a palm, lit from above; violet: no reading.  turn: (2, 2) of it."""
    way = (_SPAN_M / _PX * np.diag(k)[:2] / palm_m[2])[:, None] * turn.T
    to_image = np.column_stack((way, (k @ palm_m)[:2] / palm_m[2] - way @ np.full(2, _PX / 2)))
    how = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    z = cv2.warpAffine(depth_m.astype(np.float32), to_image, (_PX, _PX), flags=how)
    off = np.clip((z - palm_m[2]) / _NEAR_M, -1, 1)
    slope = (np.roll(z, round(_SLOPE_M / _SPAN_M * _PX), 0) - z) / _SLOPE_M
    light = np.where(np.abs(off) < 1, 0.75 + 0.25 * np.clip(slope / 2, -1, 1), 0.75)
    grey = np.uint8(255 * (0.62 - 0.38 * off) * light)[..., None] // 8 * 8
    return np.where(z[..., None] > 0, grey, np.uint8((96, 32, 64)))


def hands_in(detector: HandDetector, path: Path, count: int) -> list[Hand]:
    """The best ones of `count` frames of a recording, fingers upwards and as right hands."""
    with np.load(path, allow_pickle=False) as file:
        depth, k = file["depth_m"], file["K"].astype(float)
        seen = file["visible_fraction"] if "visible_fraction" in file else np.ones(len(depth))
    rows, hands = np.linspace(0, len(depth) - 1, count).astype(int), []
    for row in np.unique(rows[seen[rows] > 0.7]):
        image = np.ascontiguousarray(depth[row], np.float32)
        places = detector.start_search(image, k)()
        of = {side: detector.look(image, k, places, side)[:1] for side in ("right", "left")}
        found = [(one.merit, side, one) for side in of for one in of[side]]
        for _, side, hand in sorted(found, key=lambda one: -one[0])[:1]:
            u, v = hand.up[:2] / max(np.linalg.norm(hand.up[:2]), 1e-9)
            turn = np.diag((-1 if side == "left" else 1, 1)) @ ((-v, u), (-u, -v))
            palm = hand.centre_m.numpy().astype(float)
            pose = hand.keypoints.points_m.numpy() - palm
            pose = np.column_stack((pose[:, :2] @ turn.T, pose[:, 2] / 2))  # depth: less plain
            pose *= 90 / np.linalg.norm(pose[9] - pose[0])
            hands.append((f"{path.stem} {row}", tile(image, k, palm, turn), pose))
    return hands


def sheet(pairs: list[tuple[np.ndarray, np.ndarray, str]], title: str, note: str) -> np.ndarray:
    """Pairs with their captions, BGR."""
    lines = -(-len(pairs) // _COLUMNS) or 1
    cells = np.full((lines * _COLUMNS, _PX + 24, 2 * _PX + 12, 3), 255, np.uint8)
    for cell, (left, right, text) in zip(cells, pairs, strict=False):
        cell[:_PX, :_PX], cell[:_PX, _PX + 2 : 2 * _PX + 2] = left, right
        cv2.putText(cell, text, (0, _PX + 15), 0, 0.38, (0, 0, 0), 1, cv2.LINE_AA)
    page = np.vstack([np.hstack(line) for line in np.split(cells, lines)])
    return chart.titled(page, title, f"{note} Violet: no reading.")


def properties_sheet(paths: list[Path], table: str) -> np.ndarray:
    """Each property of SHOWN in a frame of a recording, with its cost by the table."""
    pairs = []
    for n, name in enumerate(SHOWN):
        with np.load(paths[n % len(paths)], allow_pickle=False) as file:
            row = int(np.argmax(file["visible_fraction"] + np.isin(file["pose_name"], _OPEN)))
            of = file["K"].astype(float), file["joints_m"][row].astype(float)
            image = file["depth_m"][row].astype(np.float32)
        before, after = (Frame(image.copy(), *of, np.random.default_rng(n)) for _ in range(2))
        change, *numbers = PROPERTIES[name]
        change(after, *numbers)
        cost = re.search(rf"\n\| {re.escape(name)} \|[^|]*\|[^|(]*\(([^)]*)\)", table)[1]
        tiles = (tile(f.depth_m, f.k, f.palm_m, np.eye(2)) for f in (before, after))
        pairs.append((*tiles, f"{name}: {cost}"))
    note = "As drawn, and with it; points of the frames with all joints within 40 mm."
    return sheet(pairs, "What properties of an image cost the pose network", note)


def main(arguments: list[str] | None = None) -> None:
    """See above."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("drawn", nargs="+", type=Path, metavar="DRAWN.npz")
    parser.add_argument("--properties", type=Path, metavar="OUT.png")
    parser.add_argument("--real", nargs="+", type=Path, metavar="REAL.npz", default=[])
    parser.add_argument("--out", type=Path, metavar="FOLDER")
    asked = parser.parse_args(arguments)
    if asked.real and (asked.out is None or asked.out.resolve().is_relative_to(ROOT)):
        parser.error("--real needs --out FOLDER, outside of this repository")
    if asked.properties:
        table = (ROOT / "docs" / "real_images.md").read_text(encoding="utf-8")
        cv2.imwrite(str(asked.properties), properties_sheet(asked.drawn, table), [16, 9])
    detector = make_hands_tracker().model.detector
    drawn = [hand for path in asked.drawn if asked.real for hand in hands_in(detector, path, 16)]
    for path in asked.real:
        pairs = []
        for name, crop, pose in hands_in(detector, path, 24):
            apart = [float(np.linalg.norm(pose - one, axis=1).mean()) for _, _, one in drawn]
            like, beside, _ = drawn[int(np.argmin(apart))]
            pairs.append((crop, beside, f"{name} | {like}, {min(apart):.0f} mm"))
        asked.out.mkdir(parents=True, exist_ok=True)
        page = sheet(pairs, path.stem, "Real, and the drawn hand whose keypoints lie most alike.")
        cv2.imwrite(str(asked.out / f"pairs_{path.stem}.png"), page)


if __name__ == "__main__":
    main()
