#!/usr/bin/env python3
"""Makes stills.npz from a git copy of the public repository adjkamel/depth_hand.

    python make_extract.py GIT_DIR OUT.npz

Writes depth_m (T, 240, 320) float32 metres, K, gesture (T,) 1 to 11, repetition (T,) 1 to 15. Needs
git, numpy and opencv.
"""

import re
import subprocess
import sys

import cv2
import numpy as np

git, out = sys.argv[1:]


def run(*args):
    return subprocess.run(
        ["git", "--git-dir=" + git, *args], capture_output=True, check=True
    ).stdout


names = [
    n.decode()
    for n in run("ls-tree", "-r", "-z", "--name-only", "HEAD", "depth").split(b"\0")
    if n.endswith(b".png")
]
rows = sorted((tuple(map(int, re.search(r"G(\d+)-T(\d+)", n).groups())), n) for n in names)
depth, label = [], []
for (gesture, repetition), name in rows:
    if repetition > 15:
        continue
    grey = cv2.imdecode(np.frombuffer(run("show", "HEAD:" + name), np.uint8), -1)
    a = grey.astype(np.int16)
    around, alike = np.pad(a, 2, mode="edge"), np.zeros(a.shape, np.uint8)
    for dy in range(5):
        for dx in range(5):
            alike += np.abs(around[dy : dy + a.shape[0], dx : dx + a.shape[1]] - a) <= 5
    depth.append(np.where((alike >= 11) & (grey > 0), (a + 4) * 0.0104, 0).astype(np.float32))
    label.append((gesture, repetition))
label = np.array(label)
K = np.array([[224.502, 0, 160], [0, 230.494, 120], [0, 0, 1]])
np.savez_compressed(out, depth_m=np.stack(depth), K=K, gesture=label[:, 0], repetition=label[:, 1])
print(len(depth), "stills")
