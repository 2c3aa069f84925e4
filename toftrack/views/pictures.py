"""Pictures as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toftrack.files.safe_files import write_whole


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Write a (H, W, 3) uint8 BGR picture, as JPEG where its name says so, else as PNG; it is there
    as a whole, or as it was.

    Raises OSError.
    """
    import cv2  # slow to import

    kind = ".jpg" if path.suffix.lower() == ".jpg" else ".png"
    done, content = cv2.imencode(kind, picture)
    if not done:
        raise OSError(f"a picture of the shape {picture.shape} cannot be encoded")
    write_whole(path, content.tobytes())
