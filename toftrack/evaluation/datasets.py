"""Public data sets of labelled depth recordings, as their authors distribute them.

**MSRA** Hand Tracking (MSRA14: Qian et al., CVPR 2014) and Hand Gesture (MSRA15: Sun et al., CVPR
2015), Intel's Creative camera, ToF, right hands. MSRA14 has six of 400 frames each:
`Subject1/000000_depth.bin` is a whole image, 240 rows of 320 float32 millimetres. MSRA15 has nine,
17 gestures each, cut out of their images: `P0/1/000000_depth.bin` begins with six int32, width,
height, left, top, right, bottom of the box of which the float32 millimetres follow. Beside the
images, `joint.txt`: the number of frames (MSRA14 also without), then 63 numbers a line, the 21
joints in millimetres, x right, y up, z towards the viewer: the wrist, then finger by finger from
the index to the little one, the thumb last.

**ICVL** hand postures (Tang et al., CVPR 2014), the same camera, left hands.
`Depth/test_seq_1/image_0000.png` is an image of 320x240 16-bit millimetres. A text file beside
`Depth` (`labels.txt` of the training part, `test_seq_1.txt` of the other) has a line a frame: the
image's path below `Depth`, then column, row and millimetres of 16 joints, the palm's middle and
root, middle and tip of each finger from the thumb on. A sequence is what lies in one folder.

**NYU** hand poses (Tompson et al., SIGGRAPH 2014), Primesense camera, right hands.
`depth_1_0000001.png` is an image of the frontal camera, 640x480: the millimetres are 256 times the
green channel plus the blue one. `joint_data.mat` holds `joint_xyz`, (3 cameras, T, 36, 3)
millimetres, x right, y up, z forward: six points for each finger from the little one to the
thumb, the tip first, then six of the palm. Of the fourteen that papers evaluate the fingers' eleven
are compared, and the two ends of the wrist as their middle; the palm's middle has no counterpart.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from toftrack.errors import ToftrackError, check_choice, reported_errors
from toftrack.files.safe_files import natural_order, open_to_read
from toftrack.frames.camera import Camera
from toftrack.recordings.images import read_png
from toftrack.recordings.matlab import read_matlab

FPS = 30.0
"""Frames a second of all data sets."""
INTEL_CREATIVE = Camera(np.array([[241.42, 0, 160], [0, 241.42, 120], [0, 0, 1]]), 320, 240)
"""The camera of MSRA and ICVL."""
NYU_CAMERA = Camera(np.array([[588.036865, 0, 320], [0, 587.075073, 240], [0, 0, 1]]), 640, 480)
_MILLIMETRE = 1e-3
_REMEDY = "copy the data set again"
_MAX_M = 10.0
"""Larger readings stand for none."""


@dataclass(frozen=True, eq=False)
class LabelledSequence:
    """Consecutive frames of one hand with the true places of some joints.

    side: 'right' or 'left'.  joints_m: (T, J, 3) metres, camera frame; the J of the data set.
    images: T files.  read: the (H, W) float32 metres of one.  left_out: labels without an image.
    """

    name: str
    side: str
    camera: Camera
    joints_m: np.ndarray
    images: Sequence[Path]
    read: Callable[[Path], np.ndarray]
    left_out: int = 0

    def frame(self, index: int) -> np.ndarray:
        """The depth of a frame, (H, W) float32 metres along the optical axis, 0 = no reading.
        Raises ToftrackError when its file is missing or damaged."""
        return self.read(self.images[index])


@dataclass(frozen=True)
class DataSet:
    """A public data set.

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


def open_data_set(name: str, folder: str | Path) -> tuple[DataSet, list[LabelledSequence]]:
    """A data set by its name, and the sequences that lie in a folder, without the labels whose
    images are missing. Raises ToftrackError: the name is unknown, or the folder lacks it."""
    check_choice("DATASET", name, DATA_SETS)
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise ToftrackError(f"there is no folder '{folder}'; give the folder of {name}")
    data_set = DATA_SETS[name]
    sequences = [_of_images(sequence) for sequence in data_set.open(folder)]
    if not sequences:
        raise ToftrackError(f"the folder '{folder}' does not hold {name}; {data_set.layout}")
    return data_set, sequences


def _of_images(labelled: LabelledSequence) -> LabelledSequence:
    there = [row for row, path in enumerate(labelled.images) if path.is_file()]
    if not there:
        raise _unusable(
            f"there is no image '{labelled.images[0]}', nor another of the sequence {labelled.name}"
        )
    images = [labelled.images[row] for row in there]
    left_out = len(labelled.images) - len(there)
    return replace(labelled, joints_m=labelled.joints_m[there], images=images, left_out=left_out)


def _unusable(what: str) -> ToftrackError:
    return ToftrackError(f"{what}; {_REMEDY}")


def _metres(millimetres: np.ndarray) -> np.ndarray:
    """float32; 0, which is no reading, where there is none within reason."""
    depth = millimetres.astype(np.float32) * np.float32(_MILLIMETRE)
    return np.where((depth > 0) & (depth < _MAX_M), depth, np.float32(0))


def _lines(path: Path) -> list[str]:
    """Those that are not empty."""
    with reported_errors(f"the file '{path}' cannot be read as text", _REMEDY, OSError, ValueError):
        with open_to_read(path) as stream:
            text = stream.read().decode("ascii")
    return [line for line in text.splitlines() if line.strip()]


def _numbers(text: str, count: int, path: Path, line: int) -> np.ndarray:
    """(count,) float64 of a line of text."""
    try:
        values = np.array(text.split(), np.float64)
    except ValueError:
        values = np.empty(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise _unusable(f"line {line} of '{path}' must consist of {count} numbers")
    return values


# MSRA

_MSRA_LABELS = "joint.txt"
_HEADER = 6


def _msra(folder: Path, pattern: str) -> list[LabelledSequence]:
    """The sequences below a folder; a single one when the folder is that of a sequence."""
    if (folder / _MSRA_LABELS).is_file():
        return [_msra_sequence(folder, folder.name)]
    found = [path for path in folder.glob(pattern) if (path / _MSRA_LABELS).is_file()]
    found.sort(key=lambda path: natural_order(path.as_posix()))
    return [_msra_sequence(path, path.relative_to(folder).as_posix()) for path in found]


def _msra_sequence(folder: Path, name: str) -> LabelledSequence:
    path = folder / _MSRA_LABELS
    lines, first = _lines(path), 1
    if lines and len(lines[0].split()) == 1:  # the number of frames
        if lines[0].strip() != str(len(lines) - 1):
            raise _unusable(
                f"'{path}' announces {lines[0].strip()} frames, but has {len(lines) - 1}"
            )
        lines, first = lines[1:], 2
    if not lines:
        raise _unusable(f"'{path}' has no labels")
    rows = [_numbers(text, 63, path, line) for line, text in enumerate(lines, first)]
    joints_m = _MILLIMETRE * np.array(rows).reshape(-1, 21, 3) * (1, -1, -1)
    images = [folder / f"{index:06d}_depth.bin" for index in range(len(rows))]
    return LabelledSequence(name, "right", INTEL_CREATIVE, joints_m, images, _msra_depth)


def _msra_depth(path: Path) -> np.ndarray:
    """(240, 320) float32 metres; what lies outside of the stored box is no reading."""
    width, height = INTEL_CREATIVE.width, INTEL_CREATIVE.height
    left, top, right, bottom, start = 0, 0, width, height, 0
    what = f"the image '{path}' is damaged, or cannot be read"
    with reported_errors(what, _REMEDY, OSError, ValueError):
        with open_to_read(path) as stream:
            content = stream.read()
        if len(content) != 4 * width * height:
            start = 4 * _HEADER
            *size, left, top, right, bottom = np.frombuffer(content, "<i4", _HEADER).tolist()
            inside = 0 <= left <= right <= width and 0 <= top <= bottom <= height
            whole = len(content) == start + 4 * (right - left) * (bottom - top)
            if not (size == [width, height] and inside and whole):
                raise ValueError("it is no depth image of 320x240 pixels")
    values = np.frombuffer(content, "<f4", offset=start).reshape(bottom - top, right - left)
    depth = np.zeros((height, width), np.float32)
    depth[top:bottom, left:right] = _metres(values)
    return depth


# ICVL

_ICVL_IMAGES = "Depth"
_ICVL_JOINTS = (2, 3, 4, 5, 6, 8, 9, 10, 12, 13, 14, 16, 17, 18, 20)
"""Root, middle and tip of each finger: for the thumb MCP, IP and TIP, else MCP, PIP and TIP. The
palm's middle, the first label, has no counterpart."""


def _icvl(folder: Path) -> list[LabelledSequence]:
    parts = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]
    return [
        sequence
        for part in parts
        if (part / _ICVL_IMAGES).is_dir()
        for labels in sorted(part.glob("*.txt"))
        for sequence in _icvl_sequences(part / _ICVL_IMAGES, labels)
    ]


def _icvl_sequences(folder: Path, labels: Path) -> list[LabelledSequence]:
    """The sequences of a file of labels, in the order in which they begin there."""
    rows: dict[str, list[tuple[Path, np.ndarray]]] = {}
    for line, text in enumerate(_lines(labels), 1):
        name, _, values = text.strip().partition(" ")
        image = folder / name.replace("\\", "/")
        row = _numbers(values, 48, labels, line).reshape(-1, 3)
        rows.setdefault(image.parent.relative_to(folder).as_posix(), []).append((image, row))
    return [_icvl_sequence(name, labelled) for name, labelled in rows.items()]


def _icvl_sequence(name: str, labelled: list[tuple[Path, np.ndarray]]) -> LabelledSequence:
    u, v, millimetres = np.moveaxis(np.array([row for _, row in labelled])[:, 1:], -1, 0)
    z, K = _MILLIMETRE * millimetres, INTEL_CREATIVE.K
    joints_m = np.stack([(u - K[0, 2]) * z / K[0, 0], (v - K[1, 2]) * z / K[1, 1], z], axis=-1)
    images = [path for path, _ in labelled]
    return LabelledSequence(name, "left", INTEL_CREATIVE, joints_m, images, _icvl_depth)


def _icvl_depth(path: Path) -> np.ndarray:
    return _metres(read_png(path, np.uint16, (INTEL_CREATIVE.height, INTEL_CREATIVE.width)))


# NYU

_NYU_LABELS, _NYU_KEY = "joint_data.mat", "joint_xyz"
_NYU_POINTS = {20: 0, 18: 3, 16: 6, 14: 9, 12: 12, 10: 15, 8: 18, 6: 21, 4: 24, 3: 25, 2: 27}
"""The labels' points of toftrack's rows: TIP and PIP of four fingers; TIP, IP, MCP of the thumb."""
_NYU_WRIST = (30, 31)
_TEST_FRAMES, _FIRST_PERSON = 8252, 2440
"""The test part shows one person up to that frame, and another from there on."""


def _nyu(folder: Path) -> list[LabelledSequence]:
    places = [folder, *(folder / part for part in ("test", "train", "dataset/test"))]
    found = [path for path in places if (path / _NYU_LABELS).is_file()]
    return [sequence for path in found for sequence in _nyu_sequences(path)]


def _nyu_sequences(folder: Path) -> list[LabelledSequence]:
    joints_m = _nyu_labels(folder / _NYU_LABELS)
    images = [folder / f"depth_1_{index + 1:07d}.png" for index in range(len(joints_m))]
    parts = {folder.name: slice(None)}
    if len(joints_m) == _TEST_FRAMES:
        first, second = slice(_FIRST_PERSON), slice(_FIRST_PERSON, None)
        parts = {f"{folder.name}_1": first, f"{folder.name}_2": second}
    return [
        LabelledSequence(name, "right", NYU_CAMERA, joints_m[part], images[part], _nyu_depth)
        for name, part in parts.items()
    ]


def _nyu_labels(path: Path) -> np.ndarray:
    """(T, 12, 3) metres, camera frame: the wrist, then the fingers' points in toftrack's order."""
    what = f"{_NYU_KEY} in the file '{path}'"
    with reported_errors(f"the file '{path}' cannot be used", _REMEDY, OSError, ValueError):
        points = read_matlab(path, _NYU_KEY)
    if points.ndim != 4 or points.shape[2:] != (36, 3) or not points.size:
        raise _unusable(f"{what} has the shape {points.shape}, not (3, T, 36, 3)")
    frontal = points[0].astype(np.float64)
    if not np.isfinite(frontal).all():
        raise _unusable(f"{what} contains NaN or infinity")
    wrist = frontal[:, _NYU_WRIST, :].mean(axis=1, keepdims=True)
    fingers = frontal[:, [_NYU_POINTS[row] for row in sorted(_NYU_POINTS)]]
    return _MILLIMETRE * np.concatenate([wrist, fingers], axis=1) * (1, -1, 1)


def _nyu_depth(path: Path) -> np.ndarray:
    image = read_png(path, np.uint8, (NYU_CAMERA.height, NYU_CAMERA.width, 3))
    return _metres(image[..., 1].astype(np.uint16) << 8 | image[..., 0])


_MSRA14 = DataSet(
    name="MSRA14",
    joints=(0, *range(5, 21), *range(1, 5)),  # the labels' thumb begins at its lowest joint, too
    tip_inset_m=0.007,
    tips=(
        "a label of a finger's end is the last point of the authors' sphere model, about the "
        "middle of the last sphere"
    ),
    layout="there must be folders Subject1, Subject2, ... with joint.txt and 000000_depth.bin",
    open=partial(_msra, pattern="Subject*"),
)
_MSRA15 = replace(
    _MSRA14,
    name="MSRA15",
    layout="there must be folders P0/1, P0/2, ... with joint.txt and 000000_depth.bin",
    open=partial(_msra, pattern="P[0-9]/*"),
)
_ICVL = DataSet(
    name="ICVL",
    joints=_ICVL_JOINTS,
    tip_inset_m=0.010,
    tips=(
        "labels are middles of parts: that of a finger's end lies about 10 mm inside of it, and "
        "roots and middles are those of the parts, not the joints' axes"
    ),
    layout="there must be a folder Depth and labels.txt or test_seq_1.txt beside it",
    open=_icvl,
)
_NYU = DataSet(
    name="NYU",
    joints=(0, *sorted(_NYU_POINTS)),
    tip_inset_m=0.007,
    tips=(
        "a label of a finger's end is the middle of the last sphere of the authors' hand model, "
        "and the wrist the middle of its two ends"
    ),
    layout="there must be joint_data.mat and depth_1_0000001.png, also in a folder test",
    open=_nyu,
)
DATA_SETS = {data_set.name: data_set for data_set in (_MSRA14, _MSRA15, _ICVL, _NYU)}
