#!/usr/bin/env python3
"""Cuts the guards, what CI tracks, from the sets that toftrack is developed on.

    python tests/data/make_guards.py DATA

DATA: the folder that holds `crowd`, `mesh-hand` and `grasps`. Writes tests/data/guards/*.npz: depth
and truth as they are, of a range of frames; without amplitude, which the tracker does not look at.
"""

from __future__ import annotations

import json
import sys
import zipfile
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
KEPT = (
    "depth_m", "K", "fps", "joints_m", "visible", "in_space", "visible_fraction", "joint_visible",
    "pose_name", "joints2_m", "visible2",
)  # fmt: skip
PER_FRAME = (*KEPT[:1], *KEPT[3:])
CUTS = {
    "back_turn": ("crowd/01_back_turn", 20, 60, "a turn: edge-on, then palm, then fist"),
    "thumb_hook": ("crowd/03_thumb_hook", 20, 60, "half closed, hooked"),
    "enter_leave": ("crowd/05_enter_leave", 40, 80, "leaves, and returns in another pose"),
    "still_face": ("crowd/07_still_face", 10, 50, "at rest before a face, frames 3 to 33"),
    "hands_front": ("crowd/10_hands_front", 40, 80, "another hand beside, the hand leaves"),
    "fist_cycle": ("mesh-hand/fist_cycle", 10, 50, "palm, fist, palm"),
    "fast_motion": ("mesh-hand/fast_motion", 10, 50, "a fast hand"),
    "ego_bare": ("grasps/06_ego_bare", 0, 40, "seen from the wearer's head"),
}
"""Which frames, from the first to before the last, and what they show."""


def cut(source: Path, first: int, last: int) -> dict[str, np.ndarray]:
    """A range of frames of a recording, as the arrays of a smaller one."""
    with np.load(source, allow_pickle=False) as archive:
        found = {key: archive[key] for key in KEPT if key in archive.files}
        metadata = json.loads(str(archive["metadata"]))
    for key in PER_FRAME:
        if key in found:
            found[key] = found[key][first:last]
    # Which loses nothing: depth is recorded in steps of 2^-11 m, and of 2^-6 m from 1 m on.
    found["depth_m"] = found["depth_m"].astype(np.float16)
    if "still" in metadata:
        rests = [(max(a - first, 0), min(b, last - 1) - first) for a, b in metadata["still"]]
        metadata["still"] = [rest for rest in rests if rest[1] > rest[0]]
    metadata.setdefault("side", "right")  # of mesh-hand, which says nothing of it
    metadata["cut"] = {"from": source.stem, "first": first, "frames": last - first}
    found["metadata"] = np.array(json.dumps(metadata))
    return found


def write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """An .npz whose members are bzip2-compressed and bear no date: the same each time."""
    with zipfile.ZipFile(path, "w") as archive:
        for key, value in arrays.items():
            entry = zipfile.ZipInfo(f"{key}.npy", (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_BZIP2
            with archive.open(entry, "w") as member:
                np.lib.format.write_array(member, np.asanyarray(value), allow_pickle=False)


def main() -> None:
    if len(sys.argv) != 2 or not Path(sys.argv[1]).is_dir():
        raise SystemExit(__doc__)
    (HERE / "guards").mkdir(exist_ok=True)
    for name, (source, first, last, _) in CUTS.items():
        path = HERE / "guards" / f"{name}.npz"
        write(path, cut(Path(sys.argv[1], f"{source}.npz"), first, last))
        print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
