"""MSRA Hand Tracking (MSRA14) and MSRA Hand Gesture (MSRA15): Intel's Creative camera, ToF.

MSRA14 (Qian et al., CVPR 2014): six right hands, 400 frames each: `Subject1/000000_depth.bin` is a
whole image, 240 rows of 320 float32 millimetres. MSRA15 (Sun et al., CVPR 2015): nine right hands,
17 gestures each, cut out of their images: `P0/1/000000_depth.bin` begins with six int32, width,
height, left, top, right, bottom of the box of which the float32 millimetres follow.

Beside the images, `joint.txt`: the number of frames (MSRA14 also without), then 63 numbers a line,
the 21 joints in millimetres, x right, y up, z towards the viewer: the wrist, then finger by finger
from the index to the little one, the thumb last.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.evaluation.datasets.base import (
    INTEL_CREATIVE,
    MILLIMETRE,
    DataSet,
    LabelledSequence,
    labelled_sequence,
    metres,
    numbers,
    read_bytes,
    read_lines,
)

_WIDTH, _HEIGHT = INTEL_CREATIVE.width, INTEL_CREATIVE.height
_LABELS = "joint.txt"
_JOINTS = (0, *range(5, 21), *range(1, 5))
"""toftrack's row of each label: the labels' thumb begins at its lowest joint, as ours does."""
_HEADER = 6
_TIP_NOTE = (
    "a label of a finger's end is the last point of the authors' sphere model, about the middle of "
    "the last sphere"
)


def _sequences(folder: Path, pattern: str) -> list[LabelledSequence]:
    """The sequences below a folder; a single one when the folder is that of a sequence."""
    if (folder / _LABELS).is_file():
        return [_sequence(folder, folder.name)]
    found = sorted(
        (path for path in folder.glob(pattern) if (path / _LABELS).is_file()), key=_natural
    )
    return [_sequence(path, path.relative_to(folder).as_posix()) for path in found]


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts Subject2 before Subject10."""
    parts = re.split(r"(\d+)", path.as_posix())
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


def _sequence(folder: Path, name: str) -> LabelledSequence:
    joints = _labels(folder / _LABELS)
    images = [folder / f"{index:06d}_depth.bin" for index in range(len(joints))]
    return labelled_sequence(name, "right", INTEL_CREATIVE, images, joints, _read_depth)


def _labels(path: Path) -> np.ndarray:
    """(T, 21, 3) metres, camera frame, in the order of the file."""
    lines = read_lines(path)
    first = 1
    if lines and len(lines[0].split()) == 1:  # the number of frames
        if lines[0].strip() != str(len(lines) - 1):
            raise ToftrackError(
                f"'{path}' announces {lines[0].strip()} frames, but has {len(lines) - 1}; copy the "
                "data set again"
            )
        lines, first = lines[1:], 2
    if not lines:
        raise ToftrackError(f"'{path}' has no labels; copy the data set again")
    rows = [numbers(text, 63, path, line) for line, text in enumerate(lines, first)]
    return MILLIMETRE * np.array(rows).reshape(-1, 21, 3) * (1, -1, -1)


def _read_depth(path: Path) -> np.ndarray:
    """(240, 320) float32 metres; what lies outside of the stored box is no reading."""
    content = read_bytes(path)
    if len(content) == 4 * _WIDTH * _HEIGHT:
        left, top, right, bottom = 0, 0, _WIDTH, _HEIGHT
        values = np.frombuffer(content, "<f4")
    else:
        header = np.frombuffer(content[: 4 * _HEADER], "<i4") if len(content) >= 24 else None
        if header is None or tuple(header[:2]) != (_WIDTH, _HEIGHT):
            raise _damaged(path)
        left, top, right, bottom = map(int, header[2:])
        inside = 0 <= left <= right <= _WIDTH and 0 <= top <= bottom <= _HEIGHT
        if not inside or len(content) != 4 * (_HEADER + (right - left) * (bottom - top)):
            raise _damaged(path)
        values = np.frombuffer(content, "<f4", offset=4 * _HEADER)
    depth = np.zeros((_HEIGHT, _WIDTH), np.float32)
    depth[top:bottom, left:right] = metres(values.reshape(bottom - top, right - left))
    return depth


def _damaged(path: Path) -> ToftrackError:
    return ToftrackError(
        f"the image '{path}' is damaged: it is no depth image of {_WIDTH}x{_HEIGHT} pixels; copy "
        "the data set again"
    )


MSRA14 = DataSet(
    name="MSRA14",
    joints=_JOINTS,
    tip_inset_m=0.007,
    tips=_TIP_NOTE,
    layout="there must be folders Subject1, Subject2, ... with joint.txt and 000000_depth.bin",
    open=partial(_sequences, pattern="Subject*"),
)
MSRA15 = DataSet(
    name="MSRA15",
    joints=_JOINTS,
    tip_inset_m=0.007,
    tips=_TIP_NOTE,
    layout="there must be folders P0/1, P0/2, ... with joint.txt and 000000_depth.bin",
    open=partial(_sequences, pattern="P[0-9]/*"),
)
