"""The overlay: the image with the skeleton beside the estimate's range image, and how it is kept.

All images are on the undistorted pixel grid of the camera. Pictures are (h, w, 3) uint8 BGR.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Self

import cv2
import numpy as np

from toftrack.camera import Camera
from toftrack.errors import ToftrackError
from toftrack.estimate import Estimate, confidence_words, gesture_words, state_words
from toftrack.output.files import write_whole
from toftrack.render.model_image import model_range_image
from toftrack.views.base import TrackedFrame
from toftrack.views.video import VideoFile, unwritable, video_library

# The palette of Okabe and Ito, which colour-blind people can tell apart; thumb to little finger.
FINGER_RGB = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (204, 121, 167))
_RED = (40, 40, 220)
_WHITE = (255, 255, 255)
CAPTION_PX = 36
"""Height of the caption above a panel's two sides."""
_BONE_M = 0.004
_TRUSTED = 0.5
"""Joints that are less likely within 40 mm are drawn hollow."""
_NEAREST_GREY, _FARTHEST_GREY = 40, 215
_SUBPIXEL_BITS = 3

VIDEO, STRIP = "overlay.mp4", "overlay.png"
_STRIP_TILES = 10
_STRIP_COLUMNS = 5
_STRIP_TILE_PX = 320
_STRIP_KEPT = 64


def panel_scale(width: int) -> int:
    """The magnification at which an image `width` pixels wide is drawn: 3 for 176, 1 for 640."""
    return max(1, round(528 / width))


def draw_panel(
    depth_m: np.ndarray,
    amplitude: np.ndarray | None,
    camera: Camera,
    estimate: Estimate,
    model_depth: np.ndarray | None,
    scale: float,
) -> np.ndarray:
    """One frame as a picture: left the camera's image with the skeleton, right the model's range.

    Above both, a caption with frame number, score, confidence, state and gesture. A red caption and
    frame mark an estimate that is lost. The skeleton is missing where the estimate is NaN; joints
    that are more likely wrong than right are hollow.

    Args:
        depth_m: (H, W) metres, 0 = no reading; shown without amplitude, nearer is brighter.
        amplitude: (H, W), shown in grey; or None.
        camera: projects the joints.
        estimate: of this frame.
        model_depth: (H, W) metres of the estimate's surface, anything not positive and finite is
            background; None leaves the right side empty. Nearer is darker, on white.
        scale: panel pixels per image pixel.

    Returns:
        (h, w, 3) uint8 BGR with h and w even; the two sides are the halves of w.
    """
    height, width = depth_m.shape
    # Even, so that a video of it can be encoded.
    size = (max(2, 2 * round(width * scale / 2)), max(2, 2 * round(height * scale / 2)))
    grey = _depth_grey(depth_m) if amplitude is None else _amplitude_grey(amplitude)
    smooth = cv2.INTER_NEAREST if amplitude is None else cv2.INTER_LINEAR
    left = cv2.cvtColor(cv2.resize(grey, size, interpolation=smooth), cv2.COLOR_GRAY2BGR)
    # A comparison with NaN is false: what nothing is known of is drawn as ever.
    doubted = estimate.joint_confidence < _TRUSTED
    scales = size[0] / width, size[1] / height
    _draw_skeleton(left, camera, estimate.joints_m, doubted, *scales)
    model: np.ndarray = np.full((height, width), 255, np.uint8)
    if model_depth is not None:
        model = range_grey(model_depth)
    # Nearest, because mixing the hand with the background would draw a dark rim around it.
    model = cv2.resize(model, size, interpolation=cv2.INTER_NEAREST)
    right = cv2.cvtColor(model, cv2.COLOR_GRAY2BGR)
    if estimate.lost:
        for side in (left, right):
            thick = max(2, size[0] // 130)
            cv2.rectangle(side, (0, 0), (size[0] - 1, size[1] - 1), _RED, 2 * thick)
    return np.vstack([_caption(estimate, size[0]), np.hstack([left, right])])


def draw_tracked(tracked: TrackedFrame) -> np.ndarray:
    """The panel of a tracked frame, (h, w, 3); see draw_panel."""
    camera = tracked.camera
    height, width = tracked.depth_m.shape
    model = model_range_image(tracked.estimate.state, tracked.shape, camera.K, height, width)
    amplitude = camera.undistort_amplitude(tracked.frame.amplitude)
    return draw_panel(
        tracked.depth_m, amplitude, camera, tracked.estimate, model, panel_scale(width)
    )


class VideoView:
    """Keeps panels as a video, overlay.mp4, and as a filmstrip of ten of them, overlay.png.

    Args:
        folder: exists; both files go into it.
        fps: of the video.
        frames: how many panels are to come at most, or None where nobody knows.

    Raises:
        ToftrackError: nothing encodes; by `add` and `close`, when a file cannot be written.
    """

    def __init__(self, folder: str | Path, fps: float, frames: int | None = None) -> None:
        self.video_path = Path(folder) / VIDEO
        self.strip_path = Path(folder) / STRIP
        video_library()  # better missed now than at the first frame
        self._fps = fps
        self._video: VideoFile | None = None
        self._size = (0, 0)
        self._count = 0
        self._tiles: list[np.ndarray] = []
        self._stride = 1 if frames is None else max(1, math.ceil(frames / _STRIP_KEPT))

    def show(self, tracked: TrackedFrame) -> None:
        """Append the frame's panel."""
        self.add(draw_tracked(tracked))

    def commands(self) -> Sequence[str]:
        """A file asks for nothing."""
        return ()

    def add(self, panel: np.ndarray) -> None:
        """Append a (h, w, 3) uint8 BGR panel; the first one decides on the size of the video."""
        if self._video is None:
            self._size = (panel.shape[1] & ~1, panel.shape[0] & ~1)
            self._video = VideoFile(self.video_path, self._fps, self._size)
        if panel.shape[1::-1] != self._size:
            panel = cv2.resize(panel, self._size, interpolation=cv2.INTER_AREA)
        self._video.add(panel)
        if self._count % self._stride == 0:
            self._keep(panel)
        self._count += 1

    def close(self) -> None:
        """Finish both files; nothing without a panel."""
        if self._video is None:
            return
        video, self._video = self._video, None
        try:
            video.close()
        finally:
            self._write_strip()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exception: object) -> None:
        # What went wrong before is what matters, such as a disk that is full.
        ended = kind is None or issubclass(kind, KeyboardInterrupt)
        with nullcontext() if ended else suppress(ToftrackError):
            self.close()

    def _write_strip(self) -> None:
        done, picture = cv2.imencode(".png", filmstrip(self._tiles))
        if not done:
            raise unwritable(self.strip_path)
        try:
            write_whole(self.strip_path, lambda stream: stream.write(picture.tobytes()))
        except OSError as error:
            raise unwritable(self.strip_path) from error

    def _keep(self, panel: np.ndarray) -> None:
        """Keep a tile; when they become too many, every other one goes and the stride doubles."""
        if len(self._tiles) == _STRIP_KEPT:
            self._tiles = self._tiles[::2]
            self._stride *= 2
            if self._count % self._stride:
                return
        self._tiles.append(film_tile(panel))


def _amplitude_grey(amplitude: np.ndarray) -> np.ndarray:
    """(H, W) uint8. The root shows the hand and the far dim background at once."""
    values = np.nan_to_num(np.asarray(amplitude, np.float32), posinf=0.0).clip(min=0)
    white = max(float(np.percentile(values, 99.5)), 1.0)
    return (255 * np.sqrt(np.minimum(values / white, 1))).astype(np.uint8)


def _depth_grey(depth_m: np.ndarray) -> np.ndarray:
    """(H, W) uint8: nearer is brighter, black where there is no reading."""
    valid = np.isfinite(depth_m) & (depth_m > 0)
    if not valid.any():
        return np.zeros(depth_m.shape, np.uint8)
    near, far = np.percentile(depth_m[valid], (1, 95))
    nearness = np.clip((far - depth_m) / max(far - near, 0.05), 0, 1)
    return np.where(valid, 30 + 225 * np.nan_to_num(nearness), 0).astype(np.uint8)


def range_grey(model_depth: np.ndarray) -> np.ndarray:
    """(H, W) uint8: nearer is darker, white where there is no surface."""
    surface = np.isfinite(model_depth) & (model_depth > 0)
    if not surface.any():
        return np.full(model_depth.shape, 255, np.uint8)
    near, far = model_depth[surface].min(), model_depth[surface].max()
    # A flat hand has hardly any range; spreading it over all greys would show noise.
    distance = (np.where(surface, model_depth, near) - near) / max(far - near, 0.08)
    grey = _NEAREST_GREY + (_FARTHEST_GREY - _NEAREST_GREY) * distance
    return np.where(surface, grey, 255).astype(np.uint8)


def _draw_skeleton(
    picture: np.ndarray,
    camera: Camera,
    joints_m: np.ndarray,
    doubted: np.ndarray,
    scale_x: float,
    scale_y: float,
) -> None:
    """Draw (21, 3) joints into the picture, in place, as wide as 4 mm would look there.

    doubted: (21,) joints that are drawn as rings.
    """
    joints_m = np.asarray(joints_m, np.float64)
    if not np.isfinite(joints_m).all() or (joints_m[:, 2] <= 0).any():
        return
    pixels = (camera.project(joints_m) + 0.5) * (scale_x, scale_y) - 0.5
    if np.abs(pixels).max() > 1e5:  # far outside, and more than the drawing's integers hold
        return
    points = [tuple(map(int, p)) for p in np.round(pixels * 2**_SUBPIXEL_BITS)]
    width = camera.K[0, 0] * scale_x * _BONE_M / float(np.median(joints_m[:, 2]))
    thick = int(np.clip(round(width), 1, max(1, picture.shape[1] // 40)))
    # All of the dark outline first, or each finger's would cross the colour of the one before.
    for outline in (2 * max(1, thick // 3), 0):
        for finger, rgb in enumerate(FINGER_RGB):
            colour = (0, 0, 0) if outline else rgb[::-1]
            chain = (0, *range(4 * finger + 1, 4 * finger + 5))
            for a, b in zip(chain[:-1], chain[1:], strict=True):
                cv2.line(
                    picture,
                    points[a],
                    points[b],
                    colour,
                    thick + outline,
                    cv2.LINE_AA,
                    _SUBPIXEL_BITS,
                )
            for joint in chain[1:]:
                radius = (thick + outline // 2) * 2**_SUBPIXEL_BITS
                cv2.circle(picture, points[joint], radius, colour, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
    for joint in np.flatnonzero(doubted[1:]) + 1:
        hole = max(1, thick // 2) * 2**_SUBPIXEL_BITS
        cv2.circle(picture, points[joint], hole, (0, 0, 0), -1, cv2.LINE_AA, _SUBPIXEL_BITS)


def _caption(estimate: Estimate, half_width: int) -> np.ndarray:
    """A strip of text as wide as the panel; the text fits into its left half, for the filmstrip."""
    colour = _RED if estimate.lost else (48, 48, 48)
    strip = np.full((CAPTION_PX, 2 * half_width, 3), colour, np.uint8)
    score = f"{estimate.score:.2f}" if math.isfinite(estimate.score) else "-"
    facts = (f"frame {estimate.index}", f"score {score}", confidence_words(estimate.confidence))
    state = ("LOST: " if estimate.lost else "") + state_words(estimate)
    text = "   ".join(filter(None, (*facts, state, gesture_words(estimate))))
    font, margin = cv2.FONT_HERSHEY_SIMPLEX, 8
    size, room = 0.8, half_width - 2 * margin
    # Step by step, because not every OpenCV's text grows in proportion.
    while size > 0.2 and cv2.getTextSize(text, font, size, 2 if size > 0.5 else 1)[0][0] > room:
        size -= 0.02
    origin = (margin, CAPTION_PX - 11)
    cv2.putText(strip, text, origin, font, size, _WHITE, 2 if size > 0.5 else 1, cv2.LINE_AA)
    return strip


def film_tile(panel: np.ndarray) -> np.ndarray:
    """A panel with its right side below its left, small."""
    half = panel.shape[1] // 2
    tile = np.vstack([panel[:, :half], panel[CAPTION_PX:, half : 2 * half]])
    factor = _STRIP_TILE_PX / half
    size = (_STRIP_TILE_PX, round(tile.shape[0] * factor))
    return cv2.resize(tile, size, interpolation=cv2.INTER_AREA)


def filmstrip(tiles: list[np.ndarray]) -> np.ndarray:
    """Ten of the tiles (all, if they are fewer), evenly spread, in rows of five."""
    count = min(_STRIP_TILES, len(tiles))
    chosen = [tiles[i] for i in np.linspace(0, len(tiles) - 1, count).round().astype(int)]
    columns = min(_STRIP_COLUMNS, count)
    gap = 8
    framed = [
        cv2.copyMakeBorder(tile, gap, 0, gap, 0, cv2.BORDER_CONSTANT, value=_WHITE)
        for tile in chosen
    ]
    framed += [np.full_like(framed[0], 255)] * (-count % columns)
    rows = [np.hstack(framed[i : i + columns]) for i in range(0, len(framed), columns)]
    return cv2.copyMakeBorder(np.vstack(rows), 0, gap, 0, gap, cv2.BORDER_CONSTANT, value=_WHITE)
