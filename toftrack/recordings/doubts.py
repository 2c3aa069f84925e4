"""What looks wrong in the arrays of a recording: frames counted last, and images of nothing."""

from __future__ import annotations

from typing import Any

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.recordings.streamed_images import Images, StreamedImages

_PER_FRAME = (
    *("timestamp_s", "joints_m", "visible", "in_space"),
    *("visible_fraction", "joint_visible"),
)
_IN_THE_MIDDLE, _ASIDE = 0.12, 0.15
"""How far from the image's middle the centre of K lies, in shares of its sides."""


def check_layout(shape: tuple[int, ...], arrays: dict[str, Any], key: str) -> None:
    """ToftrackError where the images' middle and K say that the frames are counted last."""
    last = shape[2]
    lengths = {len(arrays[name]) for name in _PER_FRAME if name in arrays and arrays[name].ndim}
    centre = np.asarray(arrays["K"])[:2, 2] if np.shape(arrays["K"]) == (3, 3) else None
    if centre is None or centre.dtype.kind not in "iuf" or shape[0] in lengths:
        return
    aside, aside_if_last = (
        np.abs(centre / (width, height) - 0.5).max() for height, width in (shape[1:], shape[:2])
    )
    if last in lengths or (aside_if_last < _IN_THE_MIDDLE and aside > _ASIDE):
        raise ToftrackError(
            f"'{key}' has the shape {shape}, which by K and the other keys is (rows, columns, "
            f"frames), but must be (frames, rows, columns); save numpy.moveaxis({key}, -1, 0)"
        )


def doubts(depth: Images) -> str:
    """What speaks against images that could be read, in a few words; "" for nothing."""
    some = some_images(depth)
    readings = some[(some > 0) & (some < np.inf)]
    if not readings.size:
        return "no pixel has a reading (0 = none); was the depth saved, and not another image?"
    if readings.size > 1 and readings.min() == readings.max():
        return f"every reading is {readings[0]:g} m, which no camera measures; was it saved whole?"
    return ""


def some_images(depth: Images) -> np.ndarray:
    """(n, H, W) of it, to judge the whole by: all of a long one would only take longer."""
    if isinstance(depth, StreamedImages):
        return np.stack([depth[index] for index in range(min(4, len(depth)))])
    return depth[np.unique(np.linspace(0, len(depth) - 1, 16).astype(int))]
