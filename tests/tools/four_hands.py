"""Four hands: two recordings of two hands, of one camera, laid over one another, and tracked.

    python tests/tools/four_hands.py FIRST.npz SECOND.npz [...] [KEY=VALUE ...]

Each pair of neighbours in the list is one composite: of every pixel the nearer reading. Prints for
each, of the frames in which every hand is visible: how often all four are usable (no visible joint
is farther off than 40 mm, and the estimate not lost), the same of each hand, and how often a slot
is at another hand than its own.
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np

from toftrack.api import make_hands_tracker

_BEHIND_M = 0.03
"""A joint that lies so far behind the reading there is hidden."""
_VISIBLE = 0.5
"""Share of the joints from which on a hand is visible."""


def composite(paths: tuple[Path, Path]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(T, H, W) depth in metres, (3, 3) K, (T, 4, 21, 3) joints, (T, 4, 21) which are visible."""
    first, second = (np.load(path, allow_pickle=False) for path in paths)
    if first["depth_m"].shape[1:] != second["depth_m"].shape[1:] or "joints2_m" not in second.files:
        raise SystemExit(f"{paths[0]} and {paths[1]} are not of one camera with two hands each")
    count = min(len(first["depth_m"]), len(second["depth_m"]))
    depths = np.stack([one["depth_m"][:count] for one in (first, second)]).astype(np.float64)
    depth = np.where(depths > 0, depths, np.inf).min(0)
    depth[np.isinf(depth)] = 0
    names = ("joints_m", "joints2_m"), ("joint_visible", "joint_visible2")
    joints, visible = (
        np.stack([one[name][:count] for one in (first, second) for name in group], 1)
        for group in names
    )
    k = first["K"].astype(np.float64)
    u, v = (
        np.rint(joints[..., axis] / joints[..., 2] * k[axis, axis] + k[axis, 2]).astype(int)
        for axis in (0, 1)
    )
    inside = (u >= 0) & (v >= 0) & (u < depth.shape[2]) & (v < depth.shape[1])
    frame = np.arange(count)[:, None, None]
    seen = depth[frame, np.where(inside, v, 0), np.where(inside, u, 0)]
    shown = inside & visible.astype(bool) & (seen > joints[..., 2] - _BEHIND_M)
    return depth.astype(np.float32), k, joints, shown


def measure(paths: tuple[Path, Path], *overrides: str) -> dict[str, float]:
    """The figures of a composite, per cent."""
    depth, k, joints, shown = composite(paths)
    tracker = make_hands_tracker("hands=4", *overrides)
    said = [tracker.step(image, k, n, n / 25) for n, image in enumerate(depth)]
    found = np.array([[one.joints_m for one in frame] for frame in said])
    lost = np.array([[one.lost for one in frame] for frame in said])
    off = np.linalg.norm(found[:, :, None] - joints[:, None], axis=-1)  # (T, slot, hand, 21)
    mean = np.where(lost[..., None], 0.3, np.nan_to_num(off, nan=0.3).mean(-1))
    slots = min(itertools.permutations(range(4)), key=lambda order: mean[:, order, range(4)].sum())
    own = off[:, slots, range(4)]  # (T, hand, 21)
    right = np.where(shown, own, 0).max(-1) < 0.04
    usable = right & ~lost[:, slots]
    visible = shown.mean(-1) >= _VISIBLE
    every = visible.all(1)
    nearest = np.nan_to_num(off, nan=9.0).mean(-1)[:, slots].argmin(2)
    taken = (nearest != np.arange(4)) & ~lost[:, slots]
    return {
        "frames": int(every.sum()),
        "all usable": 100 * usable[every].all(1).mean(),
        **{f"hand {n}": 100 * usable[visible[:, n], n].mean() for n in range(4)},
        "at another hand": 100 * taken.any(1).mean(),
    }


def main() -> None:
    """See above."""
    words = sys.argv[1:]
    paths = [Path(word) for word in words if "=" not in word]
    overrides = [word for word in words if "=" in word]
    if len(paths) < 2:
        raise SystemExit(__doc__)
    for pair in itertools.pairwise(paths):
        figures = measure(pair, *overrides)
        print(
            *(path.stem for path in pair), *(f"{k} {v:.1f}" for k, v in figures.items()), sep="; "
        )


if __name__ == "__main__":
    main()
