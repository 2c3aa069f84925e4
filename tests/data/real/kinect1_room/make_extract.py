#!/usr/bin/env python3
"""Makes kinect1_room.npz from a git copy of leonmavr/kinect-rf.

    python make_extract.py GIT_DIR OUT.npz

Reads depth_train.zip (17 PNG, 640 x 480) from HEAD: single images. Camera: Kinect v1. The program
kept only the lower eight of the camera's eleven bits; the room lies in the range whose upper bits
are 768 (1.08 to 5 m), and what is beyond it (a sofa, the same in most of the images) is taken
out. Metres are 0.1236 tan(raw / 2842.5 + 1.1863); K is the usual one of this camera. Needs git,
numpy and opencv.
"""

import io
import subprocess
import sys
import zipfile

import cv2
import numpy as np

if len(sys.argv) != 3:
    raise SystemExit(__doc__)
git, out = sys.argv[1:]
data = subprocess.run(
    ["git", "-C", git, "show", "HEAD:depth_train.zip"], capture_output=True, check=True
).stdout
archive = zipfile.ZipFile(io.BytesIO(data))
names = sorted(n for n in archive.namelist() if n.endswith(".png"))
raw = np.stack([cv2.imdecode(np.frombuffer(archive.read(n), np.uint8), 0) for n in names])
beyond = (raw < 100).mean(0) > 0.4
depth = 0.1236 * np.tan((768.0 + raw) / 2842.5 + 1.1863)
depth = np.where((raw < 240) & ~beyond, depth, 0).astype(np.float32)
K = np.array([[594.2, 0, 339.3], [0, 591.0, 242.7], [0, 0, 1]])
index = np.array([int(n[-9:-4]) for n in names])
np.savez_compressed(out, depth_m=depth, K=K, fps=1.0, frame_index=index)
print(out, depth.shape)
