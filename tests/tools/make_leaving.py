#!/usr/bin/env python3
"""Makes twelve recordings in which the hand that is meant leaves beside another hand, and returns.

    python tests/tools/make_leaving.py DATA OUT

DATA: the folder that holds `crowd` and `mesh-hand`. Writes OUT/*.npz, whose truth is of the hand
that is meant; `joints2_m` is of the other one, which stays in view, its palm within 20 cm of where
the first one leaves and comes back. Both are of recordings with one hand, of different
sides; six times the hand that leaves is of the one set, six times of the other. Hand and arm are
cut out of their recording, moved over its image by whole pixels (a shear along the depth, as if
seen a little more from the side) and merged by depth with the whole image of the other one.

    toftrack benchmark accuracy OUT --seeds 0,1,2
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).parents[1] / "data"))
from make_guards import write

FRAMES = 80
LEAVES, AWAY, RETURNS, BACK = 22, 32, 54, 64
"""The hand begins to leave, is gone, begins to return, is back; in between it moves smoothly."""
BETWEEN_M = 0.135
"""From palm to palm, at first, across the image."""
MOST_M = 0.20
"""The other hand's palm is never farther from where the first one leaves and returns."""
_FLESH_M = 0.035
"""Pixels so near to a joint or to the middle of a bone are the hand's."""
_BEHIND_M = 0.12
"""Hand and arm are what is not farther behind the hand's farthest joint than this."""
_PALM = [0, 5, 9, 13, 17]
_OTHER = {"right": "left", "left": "right"}


@dataclass(frozen=True)
class Composite:
    """first, other: SET/NAME of the recordings.  leaves: which way.

    across: where the other one is, seen from the first, +1 = to the image's right.
    """

    first: str
    other: str
    leaves: str
    across: int


COMPOSITES = {
    "01_down_palm": Composite("crowd/01_back_turn", "mesh-hand/high5_to_gun", "down", 1),
    "02_aside_hook": Composite("crowd/03_thumb_hook", "mesh-hand/fist_cycle", "aside", -1),
    "03_aside_still": Composite("crowd/07_still_face", "mesh-hand/out_of_space", "aside", 1),
    "04_down_point": Composite("crowd/08_object_passes", "crowd/01_back_turn", "down", -1),
    "05_aside_count": Composite("crowd/02_count_near", "crowd/01_back_turn", "aside", 1),
    "06_down_thumb": Composite("crowd/03_thumb_hook", "crowd/07_still_face", "down", -1),
    "07_down_gun": Composite("mesh-hand/high5_to_gun", "crowd/08_object_passes", "down", -1),
    "08_aside_fist": Composite("mesh-hand/fist_cycle", "crowd/01_back_turn", "aside", 1),
    "09_aside_edge": Composite("mesh-hand/self_occlusion", "crowd/03_thumb_hook", "aside", -1),
    "10_down_victory": Composite("mesh-hand/out_of_space", "crowd/08_object_passes", "down", 1),
    "11_aside_palm": Composite("mesh-hand/high5_to_gun", "mesh-hand/fist_cycle", "aside", -1),
    "12_down_fist": Composite("mesh-hand/fist_cycle", "mesh-hand/out_of_space", "down", 1),
}


@dataclass(frozen=True, eq=False)
class Source:
    """A recording of one hand: depth_m (T, H, W), k (3, 3), joints_m (T, 21, 3), fraction (T,)."""

    depth_m: np.ndarray
    k: np.ndarray
    joints_m: np.ndarray
    fraction: np.ndarray
    side: str

    @property
    def palm_m(self) -> np.ndarray:
        """(T, 3)."""
        return self.joints_m[:, _PALM].mean(1)


def read(path: Path) -> Source:
    """A recording's first FRAMES; a shorter one runs back and forth. Where it shows no hand, the
    nearest frame that does stands for it: what leaves here is to be known.
    """
    with np.load(path, allow_pickle=False) as archive:
        depth, joints = archive["depth_m"].astype(np.float32), archive["joints_m"]
        fraction, k = archive["visible_fraction"], archive["K"].astype(np.float64)
        side = json.loads(str(archive["metadata"])).get("side", "right")
    rows = np.arange(FRAMES) % (2 * len(depth) - 2)
    rows = np.minimum(rows, 2 * len(depth) - 2 - rows)
    seen = np.nonzero(fraction > 0.9)[0]
    rows = seen[np.abs(rows[:, None] - seen).argmin(1)]
    return Source(depth[rows], k, joints[rows].astype(np.float64), fraction[rows], side)


def mirrored(source: Source) -> Source:
    """The other hand's recording."""
    k, joints = source.k.copy(), source.joints_m * (-1, 1, 1)
    k[0, 2] = source.depth_m.shape[2] - 1 - k[0, 2]
    return Source(source.depth_m[:, :, ::-1], k, joints, source.fraction, _OTHER[source.side])


def moved(source: Source, columns: np.ndarray, rows: np.ndarray, k: np.ndarray) -> Source:
    """The recording with each image moved by whole pixels, 0 where nothing comes in.

    k: (3, 3) of the result.
    """
    columns = columns + round(k[0, 2] - source.k[0, 2])
    rows = rows + round(k[1, 2] - source.k[1, 2])
    depth = np.zeros_like(source.depth_m)
    height, width = depth.shape[1:]
    for image, before, right, down in zip(depth, source.depth_m, columns, rows, strict=True):
        if abs(right) < width and abs(down) < height:
            image[max(down, 0) : height + min(down, 0), max(right, 0) : width + min(right, 0)] = (
                before[
                    max(-down, 0) : height - max(down, 0), max(-right, 0) : width - max(right, 0)
                ]
            )
    off = np.stack((columns, rows), 1) + (source.k - k)[:2, 2]
    joints = source.joints_m.copy()
    joints[..., :2] += off[:, None] / k[[0, 1], [0, 1]] * joints[..., 2:]
    return Source(depth, k, joints, source.fraction, source.side)


def cut_out(source: Source) -> Source:
    """With nothing but the hand and its arm."""
    farthest = source.joints_m[..., 2].max(1)[:, None, None]
    depth = np.where(source.depth_m < farthest + _BEHIND_M, source.depth_m, np.float32(0))
    return Source(depth, source.k, source.joints_m, source.fraction, source.side)


def scaled(source: Source, factor: float) -> Source:
    """As much larger and farther away: the same pixels."""
    depth = source.depth_m * np.float32(factor)
    return Source(depth, source.k, source.joints_m * factor, source.fraction, source.side)


def flesh(depth_m: np.ndarray, k: np.ndarray, joints_m: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels at a hand (21, 3)."""
    fingers = np.arange(1, 21).reshape(5, 4)
    before = np.concatenate((np.zeros((5, 1), int), fingers[:, :-1]), 1)
    points = np.concatenate((joints_m, 0.5 * (joints_m[fingers] + joints_m[before]).reshape(-1, 3)))
    hand = np.zeros(depth_m.shape, bool)
    farthest = float(joints_m[:, 2].max()) + _FLESH_M
    v, u = np.nonzero((depth_m > 0) & (depth_m < farthest))
    z = depth_m[v, u].astype(np.float64)
    at = np.stack(((u - k[0, 2]) / k[0, 0] * z, (v - k[1, 2]) / k[1, 1] * z, z), 1)
    hand[v, u] = cKDTree(points).query(at, distance_upper_bound=_FLESH_M)[0] < _FLESH_M
    return hand


def way(composite: Composite, source: Source) -> tuple[np.ndarray, np.ndarray]:
    """(T,) pixels to the right and downwards by which the first hand is moved as it leaves."""
    frames = np.arange(FRAMES)
    out = np.clip((frames - LEAVES) / (AWAY - LEAVES), 0, 1)
    gone = out - np.clip((frames - RETURNS) / (BACK - RETURNS), 0, 1)
    smooth = 0.5 - 0.5 * np.cos(np.pi * gone)
    height, width = source.depth_m.shape[1:]
    if composite.leaves == "down":
        return np.zeros(FRAMES, int), np.rint(smooth * height).astype(int)
    return np.rint(-composite.across * smooth * 0.8 * width).astype(int), np.zeros(FRAMES, int)


def made(data: Path, composite: Composite) -> dict[str, np.ndarray]:
    """The arrays of a composite."""
    first, other = (read(data / f"{name}.npz") for name in (composite.first, composite.other))
    other = other if other.side != first.side else mirrored(other)
    k, whole = first.k, np.array([LEAVES, BACK])
    # Beside each other at one distance: hands differ by as much in size.
    other = scaled(
        other, float(np.divide(*(one.palm_m[whole, 2].mean() for one in (first, other))))
    )
    z, focal = float(first.palm_m[whole, 2].mean()), float(k[0, 0])
    apart = composite.across * BETWEEN_M * focal / z
    now = [focal * one.palm_m[:, 0] / one.palm_m[:, 2] + one.k[0, 2] for one in (first, other)]
    up = [focal * one.palm_m[:, 1] / one.palm_m[:, 2] + one.k[1, 2] for one in (first, other)]
    # The pair stands in the middle of the image, while the first one leaves and returns.
    middle = 0.5 * (depth_width(first) - 1)
    still = np.ones(FRAMES, int)
    to_first = round(middle - apart / 2 - now[0][whole].mean())
    to_other = round(middle + apart / 2 - now[1][whole].mean())
    level = round(up[0][whole].mean() - up[1][whole].mean())
    columns, rows = way(composite, first)
    first = cut_out(first)
    here = [
        int(flesh(d, first.k, j).sum()) for d, j in zip(first.depth_m, first.joints_m, strict=True)
    ]
    first = moved(first, columns + to_first, rows, k)
    other = moved(other, still * to_other, still * level, k)
    nearer = (first.depth_m > 0) & ((other.depth_m == 0) | (first.depth_m < other.depth_m))
    depth = np.where(nearer, first.depth_m, other.depth_m)
    hands = [
        np.stack([flesh(d, k, j) for d, j in zip(one.depth_m, one.joints_m, strict=True)])
        for one in (first, other)
    ]
    fraction = first.fraction * (hands[0] & nearer).sum((1, 2)) / np.maximum(here, 1)
    there = hands[1].sum((1, 2))
    second = other.fraction * (hands[1] & ~nearer).sum((1, 2)) / np.maximum(there, 1)
    checked(first, other, fraction, second)
    about = {
        "side": first.side,
        "side2": other.side,
        "tags": ["two_hands", "leaves_beside_another"],
    }
    about |= {"made_of": [composite.first, composite.other], "leaves": composite.leaves}
    return {
        "depth_m": depth.astype(np.float16),
        "K": k,
        "fps": np.array(25.0),
        "joints_m": first.joints_m.astype(np.float32),
        "visible": fraction >= 0.1,
        "visible_fraction": fraction.astype(np.float32),
        "joints2_m": other.joints_m.astype(np.float32),
        "visible2": second >= 0.1,
        "metadata": np.array(json.dumps(about)),
    }


def depth_width(source: Source) -> int:
    """Columns of the images."""
    return int(source.depth_m.shape[2])


def checked(first: Source, other: Source, fraction: np.ndarray, second: np.ndarray) -> None:
    """That a composite is what it is said to be."""
    for frame in (LEAVES, BACK):
        away = np.linalg.norm(
            first.palm_m[frame] - other.palm_m[max(frame - 4, 0) : frame + 5], axis=1
        )
        assert away.max() < MOST_M, f"the other hand is {away.max():.3f} m away in frame {frame}"
    assert (fraction[AWAY:RETURNS] < 0.1).all(), "the first hand does not leave"
    assert (fraction[:LEAVES] > 0.5).all(), "the first hand is hidden before it leaves"
    assert (second > 0.5).all(), (
        f"of the other hand {second.min():.2f} is in view in {second.argmin()}"
    )


def main() -> None:
    """Write all of them."""
    if len(sys.argv) != 3:
        raise SystemExit(__doc__)
    data, folder = map(Path, sys.argv[1:])
    folder.mkdir(parents=True, exist_ok=True)
    for name, composite in COMPOSITES.items():
        write(folder / f"{name}.npz", made(data, composite))
        print(name)


if __name__ == "__main__":
    main()
