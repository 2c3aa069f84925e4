"""What every public data set looks like to the rest of the program."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toftrack.camera import Camera
from toftrack.errors import ToftrackError, reported_errors
from toftrack.safe_files import open_to_read

MILLIMETRE = 1e-3
INTEL_CREATIVE = Camera(np.array([[241.42, 0, 160], [0, 241.42, 120], [0, 0, 1]]), 320, 240)
"""The camera of MSRA and ICVL."""
_MAX_M = 10.0
"""Larger readings stand for none."""


@dataclass(frozen=True, eq=False)
class LabelledSequence:
    """Consecutive frames of one hand with the true places of some joints."""

    name: str
    side: str
    """Whose hand it is, 'right' or 'left'."""
    camera: Camera
    fps: float
    joints_m: np.ndarray
    """(T, J, 3) metres, camera frame; the joints are those of the data set."""
    frame: Callable[[int], np.ndarray]
    """The depth of a frame by its number, (H, W) float32 metres along the optical axis, 0 = no
    reading. Raises ToftrackError when its file is missing or damaged."""
    left_out: int = 0
    """Labels that have no image."""

    def __len__(self) -> int:
        return len(self.joints_m)


def labelled_sequence(
    name: str,
    side: str,
    camera: Camera,
    images: Sequence[Path],
    joints_m: np.ndarray,
    read: Callable[[Path], np.ndarray],
) -> LabelledSequence:
    """A sequence at 30 frames a second, without the labels whose images are missing.

    joints_m: (T, J, 3) of all T images.  read: the depth of one.
    Raises ToftrackError where there is no image at all.
    """
    there = [row for row, path in enumerate(images) if path.is_file()]
    if not there:
        raise ToftrackError(
            f"there is no image '{images[0]}', nor another of the sequence {name}; copy the data "
            "set again"
        )
    return LabelledSequence(
        name=name,
        side=side,
        camera=camera,
        fps=30.0,
        joints_m=joints_m[there],
        frame=lambda index: read(images[there[index]]),
        left_out=len(images) - len(there),
    )


@dataclass(frozen=True)
class DataSet:
    """A public data set.

    name: as given on the command line.
    joints: rows of toftrack's 21 joints that the labels can be compared with, J of them.
    tip_inset_m: how far the labels' finger ends lie inside of toftrack's, along the last bone.
    tips: in words, how the labels' finger ends differ from toftrack's.
    layout: what its folder has to contain, a part of an error's sentence.
    open: the sequences in a folder, none where it holds something else; raises ToftrackError for
        files that are damaged.
    """

    name: str
    joints: tuple[int, ...]
    tip_inset_m: float
    tips: str
    layout: str
    open: Callable[[Path], list[LabelledSequence]]


def metres(millimetres: np.ndarray) -> np.ndarray:
    """float32; 0, which is no reading, where there is none within reason."""
    depth = millimetres.astype(np.float32) * np.float32(MILLIMETRE)
    return np.where((depth > 0) & (depth < _MAX_M), depth, np.float32(0))


def read_bytes(path: Path) -> bytes:
    """The content of a file; ToftrackError, one sentence, when it cannot be read."""
    with reported_errors(f"the file '{path}' cannot be read", "copy the data set again"):
        with open_to_read(path) as stream:
            return stream.read()


def read_lines(path: Path) -> list[str]:
    """The lines of a text file that are not empty; ToftrackError when it cannot be read."""
    try:
        text = read_bytes(path).decode("ascii")
    except UnicodeDecodeError:
        raise ToftrackError(
            f"the file '{path}' is damaged: it is no text; copy the data set again"
        ) from None
    return [line for line in text.splitlines() if line.strip()]


def numbers(text: str, count: int, path: Path, line: int) -> np.ndarray:
    """(count,) float64 of a line of text; ToftrackError names the file and the line."""
    try:
        values = np.array(text.split(), np.float64)
    except ValueError:
        values = np.empty(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ToftrackError(
            f"line {line} of '{path}' must consist of {count} numbers; copy the data set again"
        )
    return values
