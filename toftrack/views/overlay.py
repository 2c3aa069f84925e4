"""The overlay: the image with the skeleton beside the estimate's range image, and how it is kept.

All images are on the undistorted pixel grid of the camera. Pictures are (h, w, 3) uint8 BGR.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from pathlib import Path

import cv2
import numpy as np

from toftrack.errors import ToftrackError, check_number
from toftrack.frames.camera import Camera
from toftrack.frames.estimate import (
    Estimate,
    confidence_words,
    gesture_words,
    is_vacant,
    state_words,
)
from toftrack.hand.shape import HandShape
from toftrack.render.model_image import model_range_image
from toftrack.views.base import TrackedFrame, View
from toftrack.views.pictures import write_picture
from toftrack.views.skeleton import SLOT_RGB, draw_hands, side_words
from toftrack.views.video import VideoFile, writing

_RED = (40, 40, 220)
_WHITE = (255, 255, 255)
_FONT, _GAP = cv2.FONT_HERSHEY_SIMPLEX, "   "
_LARGEST, _LEAST = 1.1, 0.9
"""Of the text. The least can be read in a filmstrip that is 1280 px wide."""
CAPTION_PX = 46
"""Height of the caption above a panel's two sides, for each two hands."""
_TINT = 0.5
"""How much of its slot's colour is mixed into the range image of one of several hands."""
_NEAREST_GREY, _FARTHEST_GREY = 40, 215

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
    estimates: Sequence[Estimate],
    shapes: Sequence[HandShape],
) -> np.ndarray:
    """One frame as a picture: left the camera's image with the skeleton, right the model's range.

    Above the left, frame number, gesture and confidence; above the right, state and score. A red
    caption and frame mark an estimate that is lost, of several hands that all are. The image is the
    amplitude (H, W) in grey, without it depth_m (H, W), nearer brighter; see draw_hands for what is
    drawn of the slots' estimates. In the model's range, of hands of these shapes, nearer is darker,
    on white; several hands are tinted with their slots' colours. Returns (h, w, 3) uint8 BGR, h and
    w even; the two sides are the halves of w.
    """
    height, width = depth_m.shape
    scale = panel_scale(width)
    # Even, so that a video of it can be encoded.
    size = (max(2, 2 * round(width * scale / 2)), max(2, 2 * round(height * scale / 2)))
    grey = _depth_grey(depth_m) if amplitude is None else _amplitude_grey(amplitude)
    left = _with_hands(grey, amplitude is not None, camera, estimates, size)
    models = [
        model_range_image(estimate.state, shape, camera.K, camera.height, camera.width)
        for estimate, shape in zip(estimates, shapes, strict=True)
    ]
    # Nearest, because mixing the hand with the background would draw a dark rim around it.
    right = cv2.resize(_model_picture(models), size, interpolation=cv2.INTER_NEAREST)
    if all(estimate.lost for estimate in estimates):
        for side in (left, right):
            mark_lost(side)
    return np.vstack([_caption(estimates, size[0]), np.hstack([left, right])])


def caption_px(hands: int) -> int:
    """Height of the caption of so many hands."""
    return CAPTION_PX * ((hands + 1) // 2)


def mark_lost(picture: np.ndarray) -> None:
    """A red frame around a (h, w, 3) picture, in place."""
    height, width = picture.shape[:2]
    cv2.rectangle(picture, (0, 0), (width - 1, height - 1), _RED, 2 * max(2, width // 130))


def _with_hands(
    image: np.ndarray,
    smooth: bool,
    camera: Camera,
    estimates: Sequence[Estimate],
    size: tuple[int, int],
) -> np.ndarray:
    """A grey or BGR image at another size (w, h), with the skeletons.

    smooth: not for depth, where mixing the hand with the background shows what is not there.
    """
    how = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
    picture = cv2.resize(image, size, interpolation=how)
    if picture.ndim == 2:
        picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    height, width = image.shape[:2]
    draw_hands(picture, camera, estimates, (size[0] / width, size[1] / height))
    return picture


def draw_tracked(tracked: TrackedFrame) -> np.ndarray:
    """The panel of a tracked frame; see draw_panel."""
    amplitude = tracked.camera.undistort_amplitude(tracked.frame.amplitude)
    shapes = [hand.shape for hand in tracked.hands]
    return draw_panel(tracked.depth_m, amplitude, tracked.camera, tracked.estimates, shapes)


class VideoView(View):
    """Keeps panels as a video, overlay.mp4, and as a filmstrip of ten of them, overlay.png.

    Raises ToftrackError, by `add` and `close`, when a file cannot be written.
    """

    def __init__(self, folder: str | Path, fps: float, frames: int | None = None) -> None:
        self.video_path = Path(folder) / VIDEO
        self.strip_path = Path(folder) / STRIP
        self._fps = fps
        self._video: VideoFile | None = None
        self._size = (0, 0)
        self._count = 0
        self._tiles: list[np.ndarray] = []
        self._stride = 1 if frames is None else max(1, math.ceil(frames / _STRIP_KEPT))

    def show(self, tracked: TrackedFrame) -> None:
        """Append the frame's panel."""
        self.add(draw_tracked(tracked))

    def add(self, panel: np.ndarray) -> None:
        """Append a (h, w, 3) uint8 BGR panel; the first one decides on the size of the video."""
        if self._video is None:
            self._size = (panel.shape[1] & ~1, panel.shape[0] & ~1)
            self._video = VideoFile(self.video_path, self._fps, self._size)
        if panel.shape[1::-1] != self._size:
            panel = cv2.resize(panel, self._size, interpolation=cv2.INTER_AREA)
        self._video.add(panel)
        if self._count % self._stride == 0 and len(self._tiles) == _STRIP_KEPT:
            # Too many: every other one goes, and of those to come, too.
            self._tiles = self._tiles[::2]
            self._stride *= 2
        if self._count % self._stride == 0:
            self._tiles.append(film_tile(panel))
        self._count += 1

    def close(self) -> None:
        """Finish both files; nothing without a panel."""
        if self._video is None:
            return
        video, self._video = self._video, None
        try:
            video.close()
        finally:
            with writing(self.strip_path):
                write_picture(self.strip_path, filmstrip(self._tiles))

    def __exit__(self, kind: type[BaseException] | None, *exception: object) -> None:
        # What went wrong before is what matters, such as a disk that is full.
        ended = kind is None or issubclass(kind, KeyboardInterrupt)
        with nullcontext() if ended else suppress(ToftrackError):
            self.close()


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


def _model_picture(surfaces: Sequence[np.ndarray]) -> np.ndarray:
    """(H, W, 3): the nearest of the surfaces, each (H, W) metres; of several in their colours."""
    if len(surfaces) == 1:
        return cv2.cvtColor(range_grey(surfaces[0]), cv2.COLOR_GRAY2BGR)
    stack = np.stack([np.where(np.isfinite(s) & (s > 0), s, np.inf) for s in surfaces])
    grey = range_grey(stack.min(0))
    tint = np.array(SLOT_RGB)[:, ::-1][stack.argmin(0)]
    tint[grey == 255] = 255
    return np.round((1 - _TINT) * grey[..., None] + _TINT * tint).astype(np.uint8)


def _caption(estimates: Sequence[Estimate], half_width: int) -> np.ndarray:
    """A strip of text above the panel, half of it above each side: so few words that they can be
    read in the filmstrip, where the halves lie one below the other. Each hand of several has half
    a row.
    """
    colour = _RED if all(estimate.lost for estimate in estimates) else (48, 48, 48)
    count = 2 * caption_px(len(estimates)) // CAPTION_PX
    halves = [np.full((CAPTION_PX, half_width, 3), colour, np.uint8) for _ in range(count)]
    number = f"frame {estimates[0].index}"
    if len(estimates) == 1:
        one = estimates[0]
        score = f"{one.score:.2f}" if math.isfinite(one.score) else "-"
        _write_line(halves[0], (number, gesture_words(one)), 8)
        _write_line(halves[1], (_state(one), confidence_words(one.confidence), f"score {score}"), 8)
        return np.hstack(halves)
    for slot, (one, half) in enumerate(zip(estimates, halves, strict=False)):
        cv2.rectangle(half, (8, 10), (28, CAPTION_PX - 10), SLOT_RGB[slot][::-1], -1)
        cv2.rectangle(half, (8, 10), (28, CAPTION_PX - 10), _WHITE, 1)
        reported = _state(one) if one.lost else gesture_words(one) or _state(one)
        facts = [reported, confidence_words(one.confidence), side_words(one)]
        facts = ["no hand"] if is_vacant(one) else facts
        _write_line(half, facts if slot else [number, *facts], 38)
    return np.vstack([np.hstack(halves[row : row + 2]) for row in range(0, count, 2)])


def _state(estimate: Estimate) -> str:
    return ("LOST: " if estimate.lost else "") + state_words(estimate)


def _write_line(half: np.ndarray, facts: Sequence[str], x: int) -> None:
    """White text, in place, from x on. Where it does not fit it is smaller, but first the last
    facts are left out.
    """
    width_px = half.shape[1] - x - 8
    facts = [fact for fact in facts if fact]
    while len(facts) > 1 and _text_size(facts, _LEAST)[0] > width_px:
        facts.pop()
    size = _LARGEST
    # Step by step, because not every OpenCV's text grows in proportion.
    while size > 0.2 and _text_size(facts, size)[0] > width_px:
        size -= 0.02
    place = (x, (CAPTION_PX + _text_size(facts, size)[1]) // 2)
    text, thick = _GAP.join(facts), _thickness(size)
    cv2.putText(half, text, place, _FONT, size, _WHITE, thick, cv2.LINE_AA)


def _text_size(facts: Sequence[str], size: float) -> tuple[int, int]:
    (width, height), _ = cv2.getTextSize(_GAP.join(facts), _FONT, size, _thickness(size))
    return width, height


def _thickness(size: float) -> int:
    return 2 if size > 0.5 else 1


def film_tile(panel: np.ndarray) -> np.ndarray:
    """A panel with its right side below its left, small; each has its half of the caption."""
    half = panel.shape[1] // 2
    tile = np.vstack([panel[:, :half], panel[:, half : 2 * half]])
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


def draw(
    image: np.ndarray,
    estimate: Estimate | Sequence[Estimate],
    camera: Camera | np.ndarray,
    scale: float | None = None,
) -> np.ndarray:
    """The camera's image with the skeleton of an estimate, as the overlay video shows it.

    Joints that are not ok (`Estimate.joint_ok`) are hollow; an estimate that is lost has a red
    frame around the picture, and no skeleton where it has no joints.

    image: on the undistorted grid of `Camera.rectify`, (H, W) floating-point metres, 0 = no
    reading, (H, W) whole numbers of an amplitude, or (H, W, 3) uint8 RGB.  estimate: of
    `Tracker.step`, or those of `HandsTracker.step`.  camera: of the image, or its (3, 3) pinhole
    matrix K in pixels.  scale: pixels of the picture per pixel of the image; None makes it about
    528 wide, and leaves larger images as they are.

    Returns (h, w, 3) uint8 RGB, as Matplotlib and Pillow take it; OpenCV wants picture[..., ::-1].
    Raises ToftrackError: the image is none of these, or not of the camera's size.
    """
    grey = _checked(image)
    height, width = grey.shape[:2]
    if not isinstance(camera, Camera):
        camera = Camera(np.asarray(camera), width, height)
    if (camera.width, camera.height) != (width, height):
        raise ToftrackError(
            f"the image has {width}x{height} pixels, but the camera {camera.width}x{camera.height};"
            " give the camera that the image is of"
        )
    factor = panel_scale(width) if scale is None else scale
    check_number("scale", factor, 0, above=True)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    estimates = (estimate,) if isinstance(estimate, Estimate) else tuple(estimate)
    smooth = np.asarray(image).dtype.kind != "f"
    picture = _with_hands(grey, smooth, camera, estimates, size)
    if all(one.lost for one in estimates):
        mark_lost(picture)
    return np.ascontiguousarray(picture[..., ::-1])


def _checked(image: np.ndarray) -> np.ndarray:
    """(H, W) uint8 grey or (H, W, 3) uint8 BGR."""
    image = np.asarray(image)
    if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8 and image.size:
        return np.ascontiguousarray(image[..., ::-1])
    if image.ndim == 2 and image.size and image.dtype.kind in "fui":
        return _depth_grey(image) if image.dtype.kind == "f" else _amplitude_grey(image)
    raise ToftrackError(
        f"the image is {image.dtype} of the shape {image.shape}; give (H, W) metres or amplitude, "
        "or (H, W, 3) uint8 RGB"
    )
