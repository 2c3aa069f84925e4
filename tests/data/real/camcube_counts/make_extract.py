#!/usr/bin/env python3
"""Makes camcube_counts.npz of lucytronad/Depth-Hand-Recognition.

    python make_extract.py GIT_DIR OUT.npz

GIT_DIR: a git copy of that repository. Reads data/1.yml to data/7.yml (OpenCV matrices of float
metres, 200 x 200, along the ray) from HEAD: single images. Camera not named; 200 x 200 float
metres are those of a PMD CamCube 3.0, whose lens (12.8 mm, pixels of 45 micrometres) K is made
of. Distances become depths along the axis; edges between near and far (flying pixels) are kept.
labels: what each image shows, seen by eye. Needs git and numpy.
"""

import re
import subprocess
import sys

import numpy as np

if len(sys.argv) != 3:
    raise SystemExit(__doc__)
git, out = sys.argv[1:]
labels = "palm fist thumb_up victory three four palm".split()
K = np.array([[284.4, 0, 99.5], [0, 284.4, 99.5], [0, 0, 1]])
v, u = np.mgrid[:200, :200]
to_axis = 1 / np.sqrt(1 + ((u - K[0, 2]) / K[0, 0]) ** 2 + ((v - K[1, 2]) / K[1, 1]) ** 2)
depth = []
for n in range(1, 8):
    text = subprocess.run(
        ["git", "-C", git, "show", f"HEAD:data/{n}.yml"], capture_output=True, check=True
    ).stdout.decode()
    numbers = re.search(r"data: \[(.*?)\]", text, re.DOTALL)[1].replace(",", " ").split()
    metres = np.array(numbers, np.float32).reshape(200, 200) * to_axis
    depth.append(np.where(metres < 3, metres, 0).astype(np.float32))
np.savez_compressed(
    out,
    depth_m=np.stack(depth),
    K=K,
    fps=1.0,
    frame_index=np.arange(len(depth)),
    labels=np.array(labels),
)
print(out, len(depth), "single images")
