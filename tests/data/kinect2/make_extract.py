#!/usr/bin/env python3
"""Makes kinect2.npz (depth_m, K, fps) from a git copy of the public repository RenFeiTemp/SRN.

    python make_extract.py SRN_GIT_DIR OUT.npz

SRN_GIT_DIR: a clone or a bare git directory. Reads realtime/data/kinect2/00000002.png to
00000190.png (uint16 millimetres, 512 x 424) from HEAD. Needs git, numpy and opencv.
"""

import subprocess
import sys

import cv2
import numpy as np

if len(sys.argv) != 3:
    raise SystemExit(__doc__)
repo, out = sys.argv[1:]
frames = []
for n in range(2, 191):
    png = subprocess.run(
        ["git", "-C", repo, "show", f"HEAD:realtime/data/kinect2/{n:08d}.png"],
        capture_output=True,
        check=True,
    ).stdout
    frames.append(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED))
depth = np.stack(frames).astype(np.float32) / 1000
depth[depth > 2] = 0  # the room behind the person
K = np.array([[363.9, 0, 255.4], [0, 363.9, 206.3], [0, 0, 1]])
np.savez_compressed(out, depth_m=depth, K=K, fps=30.0, frame_index=np.arange(2, 191))
print(out, depth.shape)
