"""MediaPipe Hands on amplitude images, in an environment of its own: the far end of peer.py.

Run by that environment's Python, it imports nothing of toftrack. JSON lines and plain arrays:

- out, at first, `{"ready": {...versions}}` or `{"error": "why not"}`;
- in `{"begin": {"size": [H, W], "k": [...9], "side": "left" | "right" | "", "hands": N}}`: a new
  recording, in which so many hands are looked for;
- in `{"frame": true}`, then H * W uint16 of amplitude and H * W float32 of depth in metres: out 66
  float64, the joints (21, 3) in metres, not finite where there is no hand; the seconds that it
  took; the probability of the side; and 1.0 for a right hand, 0.0 for a left one.

**The image.** MediaPipe was trained on photographs; the amplitude, the infrared light that comes
back, is what comes nearest. The 99th percentile becomes white, the square root is taken (a
display's gamma, roughly), and the picture is enlarged to 640 columns.

**The lift.** A landmark's place in the image is MediaPipe's, and so is how much farther than the
wrist it is, in parts of the picture's width, which becomes metres by the hand's distance. That is
the median of what 3 x 3 pixels of the depth image say at each landmark, at a tip a little inwards;
a joint lies 14 mm below the skin, a tip 7. What else was tried: docs/lab/mediapipe.md.
"""

from __future__ import annotations

import importlib.metadata
import json
import math
import os
import sys
import time
from typing import Any, BinaryIO

import cv2
import numpy as np

COLUMNS = 640
WHITE_PERCENTILE = 99.0
GAMMA = 0.5
BELOW_SKIN_M, TIP_BELOW_M = 0.014, 0.007
INWARDS = 0.2
"""At a tip the depth is read so far towards the joint before it."""
SETTINGS = {
    "static_image_mode": False,
    "model_complexity": 1,
    "min_detection_confidence": 0.5,
    "min_tracking_confidence": 0.5,
}
TIPS = (4, 8, 12, 16, 20)
SIDES = {"Left": "right", "Right": "left"}
"""MediaPipe names sides as in a mirrored picture, which these are not."""


def picture(amplitude: np.ndarray) -> np.ndarray:
    """(H, W) uint16 as an 8-bit RGB picture of COLUMNS columns."""
    white = max(float(np.percentile(amplitude, WHITE_PERCENTILE)), 1.0)
    grey: np.ndarray = (255 * np.clip(amplitude / white, 0, 1) ** GAMMA).astype(np.uint8)
    scale = COLUMNS / grey.shape[1]
    if scale > 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(np.repeat(grey[..., None], 3, axis=2))


def lifted(landmarks: np.ndarray, depth_m: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Joints (21, 3) in metres; not finite where nothing is read anywhere.

    landmarks: (21, 3) x and y in parts of the image's width and height, z of its width.
    """
    height, width = depth_m.shape
    uv = landmarks[:, :2] * [width, height] - 0.5
    at, below = uv.copy(), np.full(21, BELOW_SKIN_M)
    for tip in TIPS:
        at[tip] += INWARDS * (uv[tip - 1] - uv[tip])
        below[tip] = TIP_BELOW_M
    read = np.array([_reading(depth_m, u, v) for u, v in at]) + below
    if not np.isfinite(read).any():
        return np.full((21, 3), np.nan)
    relative = landmarks[:, 2] * width * np.nanmedian(read) / k[0, 0]
    z = relative + np.nanmedian(read - relative)
    xy = (uv - k[:2, 2]) * z[:, None] / [k[0, 0], k[1, 1]]
    return np.concatenate((xy, z[:, None]), axis=1)


def _reading(depth_m: np.ndarray, u: float, v: float) -> float:
    """The median of the readings in the 3 x 3 pixels about a place, metres; NaN: none."""
    x, y = round(u), round(v)
    patch = depth_m[max(y - 1, 0) : max(y + 2, 0), max(x - 1, 0) : max(x + 2, 0)]
    patch = patch[patch > 0]
    return float(np.median(patch)) if patch.size else math.nan


def chosen(found: Any, side: str) -> tuple[Any, str, float] | None:
    """Landmarks, side and its probability of the hand that is meant.

    side: whose is wanted, "" for any: one of the other side is left out, which makes MediaPipe
    wrong without saying so less often, and costs it nothing.
    """
    hands = []
    rows = zip(found.multi_hand_landmarks or (), found.multi_handedness or (), strict=True)
    for landmarks, handedness in rows:
        reported = handedness.classification[0]
        if side in ("", SIDES[reported.label]):
            hands.append((landmarks, SIDES[reported.label], float(reported.score)))
    return max(hands, key=lambda hand: hand[2], default=None)


def serve(source: BinaryIO, sink: BinaryIO) -> None:
    """Answer until the source ends."""
    try:
        import mediapipe

        hands = mediapipe.solutions.hands.Hands
    except (ImportError, AttributeError) as error:
        _say(sink, {"error": f"{type(error).__name__}: {error}"})
        return
    versions = {name: importlib.metadata.version(name) for name in ("mediapipe", "numpy")}
    _say(sink, {"ready": versions | {"python": sys.version.split()[0]}})
    hand: Any = None
    for line in iter(source.readline, b""):
        reported = json.loads(line)
        if "begin" in reported:
            begin = reported["begin"]
            height, width = begin["size"]
            k, side = np.array(begin["k"]).reshape(3, 3), begin["side"]
            hand = hands(**SETTINGS | {"max_num_hands": begin["hands"]})
            hand.process(np.zeros((height, width, 3), np.uint8))  # loads what it needs
            continue
        amplitude = np.frombuffer(source.read(2 * height * width), np.uint16)
        depth_m = np.frombuffer(source.read(4 * height * width), np.float32)
        began = time.perf_counter()
        amplitude, depth_m = amplitude.reshape(height, width), depth_m.reshape(height, width)
        found = chosen(hand.process(picture(amplitude)), side)
        answer = np.full(66, np.nan)
        if found is not None:
            landmarks, found_side, probability = found
            places = np.array([(p.x, p.y, p.z) for p in landmarks.landmark])
            answer[:63] = lifted(places, depth_m, k).ravel()
            answer[64:] = probability, float(found_side == "right")
        answer[63] = time.perf_counter() - began
        sink.write(answer.tobytes())
        sink.flush()


def _say(sink: BinaryIO, what: dict[str, Any]) -> None:
    sink.write(json.dumps(what).encode() + b"\n")
    sink.flush()


if __name__ == "__main__":
    # MediaPipe's libraries write to standard output, too: that goes to standard error.
    with os.fdopen(os.dup(1), "wb") as answers:
        os.dup2(2, 1)
        serve(sys.stdin.buffer, answers)
