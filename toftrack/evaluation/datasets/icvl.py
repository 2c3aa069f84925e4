"""ICVL hand postures (Tang et al., CVPR 2014): left hands, Intel's Creative camera, ToF.

`Depth/test_seq_1/image_0000.png` is an image of 320x240 16-bit millimetres. A text file beside
`Depth` (`labels.txt` of the training part, `test_seq_1.txt` of the other) has a line a frame: the
image's path below `Depth`, then column, row and millimetres of 16 joints, the palm's middle and
root, middle and tip of each finger from the thumb on. A sequence is what lies in one folder.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toftrack.evaluation.datasets.base import (
    INTEL_CREATIVE,
    MILLIMETRE,
    DataSet,
    LabelledSequence,
    labelled_sequence,
    metres,
    numbers,
    read_lines,
)
from toftrack.recordings.png import read_png

_IMAGES = "Depth"
_NUMBERS = 48
_JOINTS = (2, 3, 4, 5, 6, 8, 9, 10, 12, 13, 14, 16, 17, 18, 20)
"""Root, middle and tip of each finger: for the thumb MCP, IP and TIP, else MCP, PIP and TIP. The
palm's middle, the first label, has no counterpart."""


def _open(folder: Path) -> list[LabelledSequence]:
    parts = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]
    return [
        sequence
        for part in parts
        if (part / _IMAGES).is_dir()
        for labels in sorted(part.glob("*.txt"))
        for sequence in _sequences(part, labels)
    ]


def _sequences(part: Path, labels: Path) -> list[LabelledSequence]:
    """The sequences of a file of labels, in the order in which they begin there."""
    rows: dict[str, list[tuple[Path, np.ndarray]]] = {}
    for line, text in enumerate(read_lines(labels), 1):
        name, _, values = text.strip().partition(" ")
        image = part / _IMAGES / name.replace("\\", "/")
        row = numbers(values, _NUMBERS, labels, line).reshape(-1, 3)
        rows.setdefault(image.parent.relative_to(part / _IMAGES).as_posix(), []).append(
            (image, row)
        )
    return [_sequence(name, labelled) for name, labelled in rows.items()]


def _sequence(name: str, labelled: list[tuple[Path, np.ndarray]]) -> LabelledSequence:
    images = [path for path, _ in labelled]
    u, v, millimetres = np.moveaxis(np.array([row for _, row in labelled])[:, 1:], -1, 0)
    z, K = MILLIMETRE * millimetres, INTEL_CREATIVE.K
    joints_m = np.stack([(u - K[0, 2]) * z / K[0, 0], (v - K[1, 2]) * z / K[1, 1], z], axis=-1)
    return labelled_sequence(name, "left", INTEL_CREATIVE, images, joints_m, _read_depth)


def _read_depth(path: Path) -> np.ndarray:
    """(240, 320) float32 metres."""
    return metres(read_png(path, np.uint16, (INTEL_CREATIVE.height, INTEL_CREATIVE.width)))


ICVL = DataSet(
    name="ICVL",
    joints=_JOINTS,
    tip_inset_m=0.010,
    tips=(
        "labels are middles of parts: that of a finger's end lies about 10 mm inside of it, and "
        "roots and middles are those of the parts, not the joints' axes"
    ),
    layout="there must be a folder Depth and labels.txt or test_seq_1.txt beside it",
    open=_open,
)
