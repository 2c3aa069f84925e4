#!/usr/bin/env python3
"""Makes hamer_depth.npz from a git copy of tylerlum/hamer_depth.

    python make_extract.py GIT_DIR OUT.npz

Reads data/demo/depth/*.png (16 bit, millimetres, 640 x 360) and data/demo/cam_K.txt from HEAD.
Camera not named; K and noise are those of a passive stereo camera (a ZED, which the author's
other programs use). Needs git, numpy and opencv.
"""

import subprocess
import sys

import cv2
import numpy as np

if len(sys.argv) != 3:
    raise SystemExit(__doc__)
git, out = sys.argv[1:]


def show(path):
    return subprocess.run(
        ["git", "-C", git, "show", "HEAD:" + path], capture_output=True, check=True
    ).stdout


names = [f"data/demo/depth/{n:05d}.png" for n in range(2)]
images = [cv2.imdecode(np.frombuffer(show(n), np.uint8), -1) for n in names]
depth = np.stack(images).astype(np.float32) / 1000
K = np.array(show("data/demo/cam_K.txt").decode().split(), float).reshape(3, 3)
np.savez_compressed(out, depth_m=depth, K=K, fps=30.0, frame_index=np.arange(len(names)))
print(out, depth.shape)
