#!/usr/bin/env python3
"""Makes r200_ceiling.npz of gianpy15/HandTracking.

    python make_extract.py GIT_DIR OUT.npz

GIT_DIR: a git copy of that repository. Reads resources/calibration_test.mat and
calibration_apply_test.mat from HEAD: two single images, 640 x 480, depth (16 bit, millimetres) in
the colour camera's view. Camera: Intel RealSense R200 (the repository brings its drivers); K is
the usual one of its colour stream. joints_uv: the repository's 21 joints in pixels, in toftrack's
order. Needs git, numpy and scipy.
"""

import io
import subprocess
import sys

import numpy as np
import scipy.io

if len(sys.argv) != 3:
    raise SystemExit(__doc__)
git, out = sys.argv[1:]
depth, joints = [], []
for name in ("calibration_test", "calibration_apply_test"):
    data = subprocess.run(
        ["git", "-C", git, "show", f"HEAD:resources/{name}.mat"], capture_output=True, check=True
    ).stdout
    content = scipy.io.loadmat(io.BytesIO(data))
    depth.append(content["depth"][..., 0].astype(np.float32) / 1000)
    joints.append(content["labels"][:, :2] * (640, 480))
K = np.array([[615.0, 0, 319.5], [0, 615.0, 239.5], [0, 0, 1]])
depth = np.stack(depth)
depth[depth > 10] = 0
np.savez_compressed(
    out,
    depth_m=depth,
    K=K,
    fps=1.0,
    frame_index=np.arange(2),
    joints_uv=np.stack(joints).astype(np.float32),
    labels=np.array(["palm", "pinch"]),
)
print(out, depth.shape)
