"""A picture of an estimate, for programs of one's own: `toftrack.draw`."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from toftrack.camera import Camera
from toftrack.errors import ToftrackError
from toftrack.estimate import Estimate
from toftrack.views.overlay import grey_of, mark_lost, panel_scale
from toftrack.views.skeleton import draw_hands


def draw(
    image: np.ndarray,
    estimate: Estimate | Sequence[Estimate],
    camera: Camera | np.ndarray,
    scale: float | None = None,
) -> np.ndarray:
    """The camera's image with the skeleton of an estimate, as the overlay video shows it.

    Joints that are more likely wrong than right are hollow; an estimate that is lost has a red
    frame around the picture, and no skeleton where it has no joints.

    Args:
        image: what was tracked, on the undistorted grid of `Camera.rectify`: (H, W) floating-point
            metres, 0 = no reading, (H, W) whole numbers of an amplitude, or (H, W, 3) uint8 RGB.
        estimate: of `Tracker.step`, or those of `HandsTracker.step`.
        camera: of the image, or its (3, 3) pinhole matrix K in pixels.
        scale: pixels of the picture per pixel of the image; None makes it about 528 wide, and
            leaves larger images as they are.

    Returns:
        (h, w, 3) uint8 RGB, as Matplotlib and Pillow take it; OpenCV wants picture[..., ::-1].

    Raises:
        ToftrackError: the image is none of these, or not of the camera's size.
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
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    # Depth is enlarged as it is: mixing the hand with the background would show what is not there.
    how = cv2.INTER_NEAREST if np.asarray(image).dtype.kind == "f" else cv2.INTER_LINEAR
    picture = cv2.resize(grey, size, interpolation=how)
    if picture.ndim == 2:
        picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    estimates = (estimate,) if isinstance(estimate, Estimate) else tuple(estimate)
    draw_hands(picture, camera, estimates, (size[0] / width, size[1] / height))
    if all(one.lost for one in estimates):
        mark_lost(picture)
    return np.ascontiguousarray(picture[..., ::-1])


def _checked(image: np.ndarray) -> np.ndarray:
    """(H, W) uint8 grey or (H, W, 3) uint8 BGR."""
    image = np.asarray(image)
    if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8 and image.size:
        return np.ascontiguousarray(image[..., ::-1])
    if image.ndim == 2 and image.size and image.dtype.kind in "fui":
        return grey_of(image, None) if image.dtype.kind == "f" else grey_of(None, image)
    raise ToftrackError(
        f"the image is {image.dtype} of the shape {image.shape}; give (H, W) metres or amplitude, "
        "or (H, W, 3) uint8 RGB"
    )
