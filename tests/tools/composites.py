"""Harder images, composed of recordings with truth, and how well the tracker follows hands in them.

    python tests/tools/composites.py four FIRST.npz SECOND.npz [...] [KEY=VALUE ...]
    python tests/tools/composites.py mirrored|leaving FILE.npz [...] [KEY=VALUE ...]

four: two recordings of two hands each, of one camera, laid over one another: of every pixel the
    nearer reading. Each pair of neighbours in the list is one composite.
mirrored: a recording, turned aside, laid over its own mirror image: two hands that move alike.
leaving: a recording whose camera turns away from the hand and back.

Prints for each, per cent: how often all hands are usable of the frames in which all are visible,
the same of each hand, how often one was silently wrong (toftrack/evaluation/trust.py says what that
is), and at another hand than its own.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from toftrack.api import make_hands_tracker
from toftrack.evaluation.trust import joint_errors_mm, judged, slots_of_hands, trust
from toftrack.frames.frame import Truth

_BEHIND_M = 0.03
"""A joint that lies so far behind the reading there is hidden."""
_VISIBLE = 0.1
"""Share of the joints from which on a hand is visible."""
_ASIDE_M = 0.09
"""Mean distance of a mirrored hand from the mirror."""
_BEYOND = 0.2
"""So far, in radians, a hand that leaves goes beyond the edge."""
_TIMES = 2
"""So often it leaves and comes back."""


@dataclass(frozen=True)
class Recording:
    """T frames with H hands.  depth_m: (T, rows, columns).  k: (3, 3).
    joints_m: (T, H, 21, 3).  visible: (T, H, 21) whether a joint is in the image and unhidden.
    """

    depth_m: np.ndarray
    k: np.ndarray
    joints_m: np.ndarray
    visible: np.ndarray

    @classmethod
    def load(cls, path: Path, hands: int = 1) -> Recording:
        """The first hands of a recording's file."""
        with np.load(path, allow_pickle=False) as file:
            if hands > 1 and "joints2_m" not in file.files:
                raise SystemExit(f"{path} has no truth of two hands")
            depth = file["depth_m"].astype(np.float32)
            names = [("joints_m", "joint_visible"), ("joints2_m", "joint_visible2")][:hands]
            joints = np.stack([file[name].astype(float) for name, _ in names], 1)
            visible = np.stack([file[name].astype(bool) for _, name in names], 1)
            k = file["K"].astype(float)
        return cls(depth, k, joints, visible)

    def checked(self) -> Recording:
        """The same, with what lies outside of the image or behind something not visible."""
        (_, rows, columns), z = self.depth_m.shape, self.joints_m[..., 2]
        u, v = (
            np.rint(self.joints_m[..., n] / z * self.k[n, n] + self.k[n, 2]).astype(int)
            for n in (0, 1)
        )
        inside = (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
        frame = np.arange(len(z))[:, None, None]
        seen = self.depth_m[frame, np.where(inside, v, 0), np.where(inside, u, 0)]
        shown = inside & self.visible & (z > 0) & (seen > z - _BEHIND_M)
        return Recording(self.depth_m, self.k, self.joints_m, shown)


def laid_over(first: Recording, second: Recording) -> Recording:
    """Both, of every pixel the nearer reading."""
    if first.depth_m.shape[1:] != second.depth_m.shape[1:]:
        raise SystemExit("two recordings are not of one camera")
    count = min(len(first.depth_m), len(second.depth_m))
    depths = np.stack([one.depth_m[:count] for one in (first, second)])
    depth = np.where(depths > 0, depths, np.inf).min(0)
    depth[np.isinf(depth)] = 0
    joints, visible = (
        np.concatenate([getattr(one, name)[:count] for one in (first, second)], 1)
        for name in ("joints_m", "visible")
    )
    return Recording(depth, first.k, joints, visible).checked()


def turned(one: Recording, angle_rad: np.ndarray) -> Recording:
    """A recording as a camera sees it that is turned by (T,) angles about its y axis, so that all
    moves to the left. Beyond its edges there are no readings.
    """
    (_, rows, columns), k = one.depth_m.shape, one.k
    v, u = np.mgrid[:rows, :columns]
    rays = np.stack(((u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones_like(u)), -1)
    sine, cosine, nil = np.sin(angle_rad), np.cos(angle_rad), np.zeros_like(angle_rad)
    turns = np.array([[cosine, nil, -sine], [nil, nil + 1, nil], [sine, nil, cosine]])
    turns = turns.transpose(2, 0, 1)
    depth = []
    for image, turn in zip(one.depth_m, turns, strict=True):
        source = rays @ turn  # by the inverse, as rows
        x, y = (source[..., n] / source[..., 2] * k[n, n] + k[n, 2] for n in (0, 1))
        maps = x.astype(np.float32), y.astype(np.float32)
        seen = cv2.remap(image, *maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
        depth.append(seen / source[..., 2])
    joints = np.einsum("tij,thnj->thni", turns, one.joints_m)
    return Recording(np.array(depth, np.float32), k, joints, one.visible).checked()


def bearing(one: Recording) -> np.ndarray:
    """(T,) angles to the right at which the first hand is seen."""
    middle = one.joints_m[:, 0].mean(1)
    return np.arctan2(middle[:, 0], middle[:, 2])


def mirrored(one: Recording) -> Recording:
    """A recording, turned aside, laid over its mirror image."""
    z = one.joints_m[:, 0, :, 2].mean()
    aside = bearing(one).mean() - np.arctan2(_ASIDE_M, z)
    one = turned(one, np.full(len(one.depth_m), aside))
    columns = one.depth_m.shape[2]
    of = np.rint(2 * one.k[0, 2]).astype(int) - np.arange(columns)
    inside = (of >= 0) & (of < columns)
    depth = np.where(inside, one.depth_m[:, :, np.where(inside, of, 0)], 0)
    return laid_over(one, Recording(depth, one.k, one.joints_m * [-1, 1, 1], one.visible))


def leaving(one: Recording) -> Recording:
    """A recording as a camera sees it that turns away from the hand and back."""
    count = len(one.depth_m)
    edge = np.arctan2(one.k[0, 2], one.k[0, 0]) + _BEYOND
    turns = np.arange(count) * _TIMES / count
    away = 0.5 - 0.5 * np.cos(2 * np.pi * turns)
    side = (-1.0) ** turns.astype(int)  # to the one side, then to the other
    return turned(one, away * (bearing(one) - side * edge))


def measure(scene: Recording, *overrides: str) -> dict[str, float]:
    """The figures of a composite, per cent."""
    hands = scene.joints_m.shape[1]
    tracker = make_hands_tracker(f"hands={hands}", *overrides)
    said = [tracker.step(image, scene.k, n, n / 25) for n, image in enumerate(scene.depth_m)]
    found = np.array([[one.joints_m for one in frame] for frame in said])
    lost = np.array([[one.lost for one in frame] for frame in said])
    visible = scene.visible.mean(-1) >= _VISIBLE
    truths = [Truth(scene.joints_m[:, n], visible[:, n], visible[:, n]) for n in range(hands)]
    slots = list(slots_of_hands(found, lost, truths))
    each = [judged(found[:, s], lost[:, s], hand) for s, hand in zip(slots, truths, strict=True)]
    usable, silent = (
        np.stack([getattr(one, name) for one in each], 1) for name in ("usable", "silent")
    )
    off = [[joint_errors_mm(found[:, s], hand)[1].mean(1) for hand in truths] for s in slots]
    taken = (np.argmin(off, 1).T != np.arange(hands)) & ~lost[:, slots]
    every = visible.all(1)
    return {
        "frames": int(every.sum()),
        "all usable": 100 * usable[every].all(1).mean(),
        **{f"hand {n}": trust(one).usable_pct for n, one in enumerate(each)},
        "silent": 100 * silent.any(1).mean(),
        "at another hand": 100 * taken.any(1).mean(),
    }


def composites(kind: str, paths: list[Path]) -> Iterator[tuple[str, Recording]]:
    """The composites of a kind, each with a name."""
    if kind == "four":
        for pair in itertools.pairwise(paths):
            first, second = (Recording.load(path, 2) for path in pair)
            yield f"{pair[0].stem}; {pair[1].stem}", laid_over(first, second)
    for path in paths if kind != "four" else []:
        one = Recording.load(path)
        yield path.stem, mirrored(one) if kind == "mirrored" else leaving(one)


def main() -> None:
    """See above."""
    kind, *words = sys.argv[1:] or [""]
    paths = [Path(word) for word in words if "=" not in word]
    overrides = [word for word in words if "=" in word]
    if kind not in ("four", "mirrored", "leaving") or len(paths) < 1 + (kind == "four"):
        raise SystemExit(__doc__)
    rows = []
    for name, scene in composites(kind, paths):
        rows.append(measure(scene, *overrides))
        print(name, *(f"{k} {v:.1f}" for k, v in rows[-1].items()), sep="; ", flush=True)
    means = {name: np.nanmean([row[name] for row in rows]) for name in rows[0]}
    print("mean", *(f"{name} {value:.1f}" for name, value in means.items()), sep="; ")


if __name__ == "__main__":
    main()
