#!/usr/bin/env python3
"""Makes adi_tof.npz of a git copy of analogdevicesinc/aditof_sdk.

    python make_extract.py GIT_DIR OUT.npz

Reads bindings/python/examples/gesture_recognition/Nfingers.png, N = 0 to 5, of commit af128282
(branch gesture-recognition-challenge): single images, 640 x 480, depth in OpenCV's rainbow of 256
colours, which is undone without any remainder. Camera: an Analog Devices Time-of-Flight board
(AD-96TOF1 or AD-FXTOF1). Colour 255 is the end of the near range, 0.8 m in the repository's
library, so a step is 3.1 mm; K is of the boards' field of view, 90 x 69.2 degrees. labels: what
each shows. Needs git, numpy and opencv.
"""

import subprocess
import sys

import cv2
import numpy as np

if len(sys.argv) != 3:
    raise SystemExit(__doc__)
git, out = sys.argv[1:]
labels = "fist pointing victory three four palm".split()
rainbow = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_RAINBOW)[0]
value = np.zeros(1 << 24, np.uint8)
value[rainbow.astype(int) @ [65536, 256, 1]] = np.arange(256)
depth = []
for n in range(6):
    path = f"af128282:bindings/python/examples/gesture_recognition/{n}fingers.png"
    png = subprocess.run(["git", "-C", git, "show", path], capture_output=True, check=True).stdout
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    step = value[image.astype(int) @ [65536, 256, 1]]
    depth.append(np.where(step < 254, step * (0.8 / 255), 0).astype(np.float32))
K = np.array([[320.0, 0, 319.5], [0, 347.9, 239.5], [0, 0, 1]])
np.savez_compressed(
    out,
    depth_m=np.stack(depth),
    K=K,
    fps=1.0,
    frame_index=np.arange(len(depth)),
    labels=np.array(labels),
)
print(out, len(depth), "single images")
