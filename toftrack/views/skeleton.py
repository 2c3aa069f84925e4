"""Skeletons drawn into the camera's image, and how those of several hands are told apart.

Pictures are (h, w, 3) uint8 BGR.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from toftrack.frames.camera import Camera
from toftrack.frames.estimate import Estimate, is_vacant

# The palette of Okabe and Ito, which colour-blind people can tell apart; thumb to little finger.
FINGER_RGB = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (204, 121, 167))
SLOT_RGB = (
    *((0, 114, 178), (213, 94, 0), (0, 125, 125), (140, 60, 160)),
    *((125, 95, 0), (90, 90, 90), (75, 75, 215), (0, 100, 30)),
)
"""Of the slots of several hands, the first two of the same palette; dark enough for white text."""
_BLACK, _WHITE = (0, 0, 0), (255, 255, 255)
_BONE_M = 0.004
_DASH, _GAP = 0.5, 2.0
"""Of the bones of joints that are not ok, in widths of the line with its outline."""
_SUBPIXEL_BITS = 3
_WRIST = 0
_LABEL, _LABEL_GAP_PX = 0.5, 6


def draw_hands(
    picture: np.ndarray, camera: Camera, estimates: Sequence[Estimate], scale: tuple[float, float]
) -> None:
    """Draw the skeletons of the slots into the camera's image, in place, as wide as 4 mm would look
    there; of several hands the nearer over the farther, each outlined in its slot's colour and with
    its side below the wrist. Joints that are not ok are hollow, and the bones that end there
    dashed, but for those of a single hand that is lost; of several hands all of one that is.

    scale: picture pixels per image pixel, across and down.
    """
    if len(estimates) == 1:
        # A single hand that is lost has a red frame already; only some of its joints may be wrong.
        doubted = ~estimates[0].joint_ok & (not estimates[0].lost)
        _draw_skeleton(picture, camera, estimates[0].joints_m, doubted, *scale, _BLACK)
        return
    there = [pair for pair in enumerate(estimates) if not is_vacant(pair[1])]
    there.sort(key=lambda pair: -float(np.median(pair[1].joints_m[:, 2])))
    labels = []
    for slot, one in there:
        doubted, rim = ~one.joint_ok | one.lost, SLOT_RGB[slot][::-1]
        wrist = _draw_skeleton(picture, camera, one.joints_m, doubted, *scale, rim)
        if wrist is not None:
            labels.append((side_words(one) or "?", wrist, rim))
    taken: list[tuple[int, int, int, int]] = []
    for label in labels:  # last, because they are smaller than a hand
        taken.append(_draw_label(picture, *label, taken))


def side_words(estimate: Estimate) -> str:
    """Whose hand it is and how sure, for people: "right", "left 83 %"; empty where nobody says."""
    sure = estimate.side_probability
    # What was given needs no number.
    share = f"{min(round(100 * sure), 99)} %" if math.isfinite(sure) and sure < 1 else ""
    return f"{estimate.side} {share}".strip()


def _draw_label(
    picture: np.ndarray,
    text: str,
    below: tuple[int, int],
    colour: tuple[int, ...],
    taken: Sequence[tuple[int, int, int, int]],
) -> tuple[int, int, int, int]:
    """Text in a box below a place, moved so that all of it is in the picture where it fits, and
    does not cover another one.

    taken: left, top, right and bottom of the other ones; returns those of this one.
    """
    font, margin = cv2.FONT_HERSHEY_SIMPLEX, 3
    (width, height), base = cv2.getTextSize(text, font, _LABEL, 1)
    x = int(np.clip(below[0] - width // 2, margin, max(margin, picture.shape[1] - width - margin)))
    lowest = picture.shape[0] - base - margin
    y = int(np.clip(below[1] + height + 2 * _LABEL_GAP_PX, height + margin, lowest))
    left, top, right, bottom = x - margin, y - height - margin, x + width + margin, y + base
    for other in sorted(taken, key=lambda box: box[1]):
        if left < other[2] and right > other[0] and other[1] <= bottom and top <= other[3]:
            down = other[3] + 1 - top
            down = down if y + down <= lowest else other[1] - 1 - bottom
            y, top, bottom = (v + down for v in (y, top, bottom))
    cv2.rectangle(picture, (left, top), (right, bottom), colour, -1)
    cv2.putText(picture, text, (x, y), font, _LABEL, _WHITE, 1, cv2.LINE_AA)
    return left, top, right, bottom


def _draw_skeleton(
    picture: np.ndarray,
    camera: Camera,
    joints_m: np.ndarray,
    doubted: np.ndarray,
    scale_x: float,
    scale_y: float,
    rim: tuple[int, ...],
) -> tuple[int, int] | None:
    """Draw (21, 3) joints into the picture, in place; returns where the wrist is, px, None where
    nothing was drawn.

    doubted: (21,) joints that are drawn as rings, their bones dashed.  rim: colour of the outline.
    """
    joints_m = np.asarray(joints_m, np.float64)
    if not np.isfinite(joints_m).all() or (joints_m[:, 2] <= 0).any():
        return None
    pixels = (camera.project(joints_m) + 0.5) * (scale_x, scale_y) - 0.5
    if np.abs(pixels).max() > 1e5:  # far outside, and more than the drawing's integers hold
        return None
    points = np.round(pixels * 2**_SUBPIXEL_BITS).astype(int)
    width = camera.K[0, 0] * scale_x * _BONE_M / float(np.median(joints_m[:, 2]))
    thick = int(np.clip(round(width), 1, max(1, picture.shape[1] // 40)))
    # All of the outline first, or each finger's would cross the colour of the one before.
    for outline in (2 * max(1, thick // 3), 0):
        for finger, rgb in enumerate(FINGER_RGB):
            colour = rim if outline else rgb[::-1]
            chain = (0, *range(4 * finger + 1, 4 * finger + 5))
            for a, b in zip(chain[:-1], chain[1:], strict=True):
                # Alike for the outline and the colour, or the dashes would not lie on each other.
                dash_px = (thick + 2 * max(1, thick // 3)) * float(doubted[b])
                for ends in _strokes(points[a], points[b], dash_px * 2**_SUBPIXEL_BITS):
                    cv2.line(picture, *ends, colour, thick + outline, cv2.LINE_AA, _SUBPIXEL_BITS)
            for joint in chain[1:]:
                radius = (thick + outline // 2) * 2**_SUBPIXEL_BITS
                at = points[joint].tolist()
                cv2.circle(picture, at, radius, colour, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
    for joint in np.flatnonzero(doubted[1:]) + 1:
        hole, at = max(1, thick // 2) * 2**_SUBPIXEL_BITS, points[joint].tolist()
        cv2.circle(picture, at, hole, (0, 0, 0), -1, cv2.LINE_AA, _SUBPIXEL_BITS)
    x, y = np.round(pixels[_WRIST]).astype(int).tolist()
    return x, y


def _strokes(begin: np.ndarray, end: np.ndarray, width: float) -> list[tuple[list[int], list[int]]]:
    """The lines from one place (2,) to another; dashes for a line of that width, one for 0."""
    length = float(np.hypot(*(end - begin)))
    if width == 0 or length == 0:
        return [(begin.tolist(), end.tolist())]
    starts = np.arange(0.5 * _GAP * width, length, (_DASH + _GAP) * width)
    parts = ((start / length, min((start + _DASH * width) / length, 1)) for start in starts)
    way = end - begin
    return [
        ((begin + low * way).astype(int).tolist(), (begin + high * way).astype(int).tolist())
        for low, high in parts
    ]
