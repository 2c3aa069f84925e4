"""Four hands, composed of recordings with truth, and how well the tracker follows them.

    python tests/tools/composites.py FIRST.npz SECOND.npz [...] [KEY=VALUE ...]

Each pair of neighbours in the list, two recordings of two hands of one camera, is laid over one
another: of every pixel the nearer reading.

Prints for each, per cent: how often all hands are usable of the frames in which all are visible,
the same of each hand, how often one was silently wrong (toftrack/evaluation/trust.py says what that
is), and at another hand than its own.
"""

import itertools
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from toftrack.api import make_hands_tracker
from toftrack.evaluation.trust import joint_errors_mm, judged, slots_of_hands, trust
from toftrack.frames.frame import Truth

_BEHIND_M = 0.03
"""A joint that lies so far behind the reading there is hidden."""
_VISIBLE = 0.1
"""Share of the joints from which on a hand is visible."""


class Recording(NamedTuple):
    """T frames with H hands.  depth_m: (T, rows, columns).  k: (3, 3).
    joints_m: (T, H, 21, 3).  visible: (T, H, 21) whether a joint is in the image and unhidden.
    """

    depth_m: np.ndarray
    k: np.ndarray
    joints_m: np.ndarray
    visible: np.ndarray


def two_hands(path: Path) -> Recording:
    """Those of a recording's file."""
    with np.load(path, allow_pickle=False) as file:
        if "joints2_m" not in file.files:
            raise SystemExit(f"{path} has no truth of two hands")
        joints = np.stack((file["joints_m"], file["joints2_m"]), 1).astype(float)
        visible = np.stack((file["joint_visible"], file["joint_visible2"]), 1).astype(bool)
        return Recording(file["depth_m"].astype(np.float32), file["K"], joints, visible)


def laid_over(first: Recording, second: Recording) -> Recording:
    """Both, of every pixel the nearer reading."""
    if first.depth_m.shape[1:] != second.depth_m.shape[1:]:
        raise SystemExit("two recordings are not of one camera")
    count, k = min(len(first.depth_m), len(second.depth_m)), first.k
    depths = np.stack((first.depth_m[:count], second.depth_m[:count]))
    depth = np.where(depths > 0, depths, np.inf).min(0)
    depth[np.isinf(depth)] = 0
    joints = np.concatenate((first.joints_m[:count], second.joints_m[:count]), 1)
    visible = np.concatenate((first.visible[:count], second.visible[:count]), 1)
    z, (rows, columns) = joints[..., 2], depth.shape[1:]
    u, v = (np.rint(joints[..., n] / z * k[n, n] + k[n, 2]).astype(int) for n in (0, 1))
    inside = (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    frame = np.arange(count)[:, None, None]
    seen = depth[frame, np.where(inside, v, 0), np.where(inside, u, 0)]
    visible &= inside & (z > 0) & (seen > z - _BEHIND_M)
    return Recording(depth, k, joints, visible)


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


def main() -> None:
    """See above."""
    paths = [Path(word) for word in sys.argv[1:] if "=" not in word]
    overrides = [word for word in sys.argv[1:] if "=" in word]
    if len(paths) < 2:
        raise SystemExit(__doc__)
    rows = []
    for pair in itertools.pairwise(paths):
        rows.append(measure(laid_over(*map(two_hands, pair)), *overrides))
        figures = (f"{name} {value:.1f}" for name, value in rows[-1].items())
        print(*(path.stem for path in pair), *figures, sep="; ", flush=True)
    means = {name: np.nanmean([row[name] for row in rows]) for name in rows[0]}
    print("mean", *(f"{name} {value:.1f}" for name, value in means.items()), sep="; ")


if __name__ == "__main__":
    main()
