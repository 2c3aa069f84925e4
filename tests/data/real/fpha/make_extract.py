#!/usr/bin/env python3
"""Makes fpha.npz from a git copy of guiggh/hand_pose_action.

    python make_extract.py GIT_DIR OUT.npz

Reads Video_files/Subject_1/put_salt/1/depth/*.png (16 bit, millimetres, 640 x 480) from HEAD.
Camera: Intel RealSense SR300 on the shoulder or head; K is that of the repository's README (depth
sensor). Needs git, numpy and opencv.
"""

import subprocess
import sys

import cv2
import numpy as np

if len(sys.argv) != 3:
    raise SystemExit(__doc__)
git, out = sys.argv[1:]
folder = "Video_files/Subject_1/put_salt/1/depth/"


def run(*args):
    return subprocess.run(["git", "-C", git, *args], capture_output=True, check=True).stdout


names = sorted(run("ls-tree", "--name-only", "HEAD", folder).decode().split())
images = [cv2.imdecode(np.frombuffer(run("show", "HEAD:" + n), np.uint8), -1) for n in names]
K = np.array([[475.066, 0, 315.945], [0, 475.066, 245.287], [0, 0, 1]])
depth = np.stack(images).astype(np.float32) / 1000
np.savez_compressed(out, depth_m=depth, K=K, fps=30.0, frame_index=np.arange(len(names)))
print(out, depth.shape)
