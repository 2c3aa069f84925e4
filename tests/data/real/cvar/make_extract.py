#!/usr/bin/env python3
"""Makes cvar_pN.npz of a git copy of augcog/OpenARK_test.

    python make_extract.py GIT_DIR OUT.npz [SEQUENCE]

SEQUENCE: P1, P3, P4, P5, P6 or P7; without it, the one that OUT's name ends with (cvar_p4.npz).
Reads CVAR/SEQUENCE/*_depth.png (16 bit, millimetres, 32001 = no reading) and
CVAR/SEQUENCE/joint.txt from HEAD. Camera: Creative Senz3D (Time of Flight, 320 x 240), on the
head; K is that of CVAR/README. Depth and truth of P1 and P3 are multiplied by 0.7: as they are,
the hand is 0.27 m long, and its bones are exactly 1 / 0.7 of those of the other four sequences of
the same person. Truth: 21 joints (u, v, millimetres) in the order base of the palm (some 45 mm
beyond the wrist), then MCP, PIP, DIP, tip of index, middle, ring, little, thumb; written in
toftrack's order, thumb first. Needs git, numpy and opencv.
"""

import subprocess
import sys

import cv2
import numpy as np

if len(sys.argv) not in (3, 4):
    raise SystemExit(__doc__)
git, out = sys.argv[1:3]
sequence = sys.argv[3] if len(sys.argv) > 3 else out.removesuffix(".npz")[-2:].upper()


def show(*paths):
    batch = "".join(f"HEAD:{path}\n" for path in paths).encode()
    command = ["git", "-C", git, "cat-file", "--batch"]
    data = subprocess.run(command, input=batch, capture_output=True, check=True).stdout
    blobs = []
    while data:
        head, data = data.split(b"\n", 1)
        size = int(head.split()[2])
        blobs.append(data[:size])
        data = data[size + 1 :]
    return blobs


K = np.array([[224.502, 0, 160], [0, 230.494, 120], [0, 0, 1]])
depth, joints = [], []
scale = 0.0007 if sequence in ("P1", "P3") else 0.001
lines = [line.split() for line in show(f"CVAR/{sequence}/joint.txt")[0].decode().splitlines()[1:]]
images = show(*(line[0].removeprefix("./") for line in lines))
for (_, *numbers), png in zip(lines, images, strict=True):
    image = cv2.imdecode(np.frombuffer(png, np.uint8), -1)[:, :320]
    depth.append(np.where(image < 32000, image, 0).astype(np.float32) * np.float32(scale))
    u, v, z = np.array(numbers, float).reshape(21, 3).T
    x = (u - K[0, 2]) / K[0, 0] * z
    y = (v - K[1, 2]) / K[1, 1] * z
    joints.append(np.stack([x, y, z], -1) * scale)
order = [0, *range(17, 21), *range(1, 17)]
np.savez_compressed(
    out,
    depth_m=np.stack(depth),
    K=K,
    fps=30.0,
    frame_index=np.arange(len(depth)),
    joints_m=np.stack(joints)[:, order].astype(np.float32),
)
print(out, len(depth), "frames")
