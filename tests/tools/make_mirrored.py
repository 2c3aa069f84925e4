#!/usr/bin/env python3
"""Makes twelve recordings of two hands: each a recording of one hand and its own mirror image.

    python tests/tools/make_mirrored.py DATA OUT

DATA: the folder that holds `crowd` and `mesh-hand`. Writes OUT/*.npz. The mirror image's hand and
arm are cut out, moved by whole pixels and, in depth, by a factor, and merged by depth with the
whole recording, so that the palms are 8 to 15 cm apart on average. Both hands move alike, in
opposite directions across: one is in front of the other for some of the time, and now and then one
is in the other, which no two hands are.

    toftrack benchmark accuracy OUT --hands 2 --seeds 0,1,2
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from make_leaving import cut_out, flesh, mirrored, moved, read, scaled, write


@dataclass(frozen=True)
class Pair:
    """A recording and its mirror image.

    across_m: where the mirror image's palm is, seen from the other one, + = to the image's right.
    depth: how many times as far away it is.
    """

    recording: str
    across_m: float
    depth: float


PAIRS = {
    "01_back_turn": Pair("crowd/01_back_turn", 0.15, 1.00),
    "02_count_near": Pair("crowd/02_count_near", -0.12, 1.10),
    "03_thumb_hook": Pair("crowd/03_thumb_hook", 0.10, 0.93),
    "04_point_at_camera": Pair("crowd/04_point_at_camera", -0.15, 1.00),
    "05_fast_far": Pair("crowd/06_fast_far", 0.12, 1.08),
    "06_still_face": Pair("crowd/07_still_face", -0.10, 0.93),
    "07_ok_relaxed": Pair("crowd/11_ok_relaxed", 0.08, 1.12),
    "08_down_sideways": Pair("crowd/12_down_sideways", -0.15, 1.00),
    "09_fist": Pair("mesh-hand/fist_cycle", 0.08, 1.00),
    "10_gun": Pair("mesh-hand/high5_to_gun", -0.12, 0.90),
    "11_any": Pair("mesh-hand/out_of_space", 0.12, 1.08),
    "12_edge": Pair("mesh-hand/self_occlusion", -0.10, 1.12),
}


def made(data: Path, pair: Pair) -> dict[str, np.ndarray]:
    """The arrays of a recording."""
    first = read(data / f"{pair.recording}.npz")
    other = scaled(mirrored(cut_out(first)), pair.depth)
    k, n = first.k, len(first.depth_m)
    z, focal = float(first.palm_m[:, 2].mean()), float(k[0, 0])
    at = [focal * one.palm_m[:, :2] / one.palm_m[:, 2:] + one.k[:2, 2] for one in (first, other)]
    apart = at[0].mean(0) - at[1].mean(0) + (focal * pair.across_m / z, 0.0)
    right, down = np.rint(apart).astype(int)
    other = moved(other, np.full(n, right), np.full(n, down), k)
    nearer = (other.depth_m > 0) & ((first.depth_m == 0) | (other.depth_m < first.depth_m))
    hands = [
        np.stack([flesh(d, k, j) for d, j in zip(one.depth_m, one.joints_m, strict=True)])
        for one in (first, other)
    ]
    seen = [
        one.fraction * (hand & of).sum((1, 2)) / np.maximum(hand.sum((1, 2)), 1)
        for one, hand, of in ((first, hands[0], ~nearer), (other, hands[1], nearer))
    ]
    about = {
        "side": first.side,
        "side2": other.side,
        "tags": ["two_hands", "mirror_image"],
        "made_of": [pair.recording],
    }
    return {
        "depth_m": np.where(nearer, other.depth_m, first.depth_m).astype(np.float16),
        "K": k,
        "fps": np.array(25.0),
        "joints_m": first.joints_m.astype(np.float32),
        "visible": seen[0] >= 0.1,
        "visible_fraction": seen[0].astype(np.float32),
        "joints2_m": other.joints_m.astype(np.float32),
        "visible2": seen[1] >= 0.1,
        "visible_fraction2": seen[1].astype(np.float32),
        "metadata": np.array(json.dumps(about)),
    }


def main() -> None:
    """Write all of them."""
    if len(sys.argv) != 3:
        raise SystemExit(__doc__)
    data, folder = map(Path, sys.argv[1:])
    folder.mkdir(parents=True, exist_ok=True)
    for name, pair in PAIRS.items():
        write(folder / f"{name}.npz", made(data, pair))
        print(name)


if __name__ == "__main__":
    main()
