"""NYU hand poses (Tompson et al., SIGGRAPH 2014): right hands, Primesense camera.

`depth_1_0000001.png` is an image of the frontal camera, 640x480: the millimetres are 256 times the
green channel plus the blue one. `joint_data.mat` holds `joint_xyz`, (3 cameras, T, 36, 3)
millimetres, x right, y up, z forward: six points for each finger from the little one to the
thumb, the tip first, then six of the palm. Of the fourteen that papers evaluate the fingers' eleven
are compared, and the two ends of the wrist as their middle; the palm's middle has no counterpart.
"""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import numpy as np

from toftrack.camera import Camera
from toftrack.errors import ToftrackError
from toftrack.evaluation.datasets.base import (
    MILLIMETRE,
    DataSet,
    LabelledSequence,
    labelled_sequence,
    metres,
    read_bytes,
)
from toftrack.recordings.png import read_png

_WIDTH, _HEIGHT = 640, 480
_CAMERA = Camera(np.array([[588.036865, 0, 320], [0, 587.075073, 240], [0, 0, 1]]), _WIDTH, _HEIGHT)
_LABELS, _KEY = "joint_data.mat", "joint_xyz"
_POINTS = {20: 0, 18: 3, 16: 6, 14: 9, 12: 12, 10: 15, 8: 18, 6: 21, 4: 24, 3: 25, 2: 27}
"""The labels' points of toftrack's rows: TIP and PIP of four fingers; TIP, IP, MCP of the thumb."""
_WRIST = (30, 31)
_TEST_FRAMES, _FIRST_PERSON = 8252, 2440
"""The test part shows one person up to that frame, and another from there on."""
_PROGRAM = """
import io, sys
import numpy
from scipy.io import loadmat
name, file = sys.argv[1], io.BytesIO(sys.stdin.buffer.read())
arrays = loadmat(file, variable_names=[name])
if name not in arrays:
    raise ValueError(f"it has no array named {name}")
if getattr(arrays[name], "dtype", numpy.dtype(object)).kind not in "fiu":
    raise ValueError(f"{name} does not consist of real numbers")
numpy.save(sys.stdout.buffer, arrays[name], allow_pickle=False)
"""
"""Reads the file from standard input and writes the array to standard output as `.npy`. SciPy's
reader can crash on a damaged file, and so runs in a process of its own."""


def _open(folder: Path) -> list[LabelledSequence]:
    places = [folder, *(folder / part for part in ("test", "train", "dataset/test"))]
    found = [path for path in places if (path / _LABELS).is_file()]
    return [sequence for path in found for sequence in _sequences(path)]


def _sequences(folder: Path) -> list[LabelledSequence]:
    joints = _labels(folder / _LABELS)
    count = len(joints)
    cuts = [0, _FIRST_PERSON, count] if count == _TEST_FRAMES else [0, count]
    parts = [range(*cut) for cut in zip(cuts, cuts[1:], strict=False)]
    names = [f"{folder.name}_{number}" for number in range(1, len(parts) + 1)]
    if len(parts) == 1:
        names = [folder.name]
    return [
        _sequence(folder, name, joints, frames) for name, frames in zip(names, parts, strict=True)
    ]


def _sequence(folder: Path, name: str, joints: np.ndarray, frames: range) -> LabelledSequence:
    images = [folder / f"depth_1_{index + 1:07d}.png" for index in frames]
    labels = joints[frames.start : frames.stop]
    return labelled_sequence(name, "right", _CAMERA, images, labels, _read_depth)


def _labels(path: Path) -> np.ndarray:
    """(T, 12, 3) metres, camera frame: the wrist, then the fingers' points in toftrack's order."""
    points = read_numbers(path, _KEY)
    if points.ndim != 4 or points.shape[2:] != (36, 3) or not points.size:
        raise _damaged(path, f"has the shape {points.shape}, not (3, T, 36, 3)")
    frontal = points[0].astype(np.float64)
    if not np.isfinite(frontal).all():
        raise _damaged(path, "contains NaN or infinity")
    wrist = frontal[:, _WRIST, :].mean(axis=1, keepdims=True)
    fingers = frontal[:, [_POINTS[row] for row in sorted(_POINTS)]]
    return MILLIMETRE * np.concatenate([wrist, fingers], axis=1) * (1, -1, 1)


def read_numbers(path: Path, name: str) -> np.ndarray:
    """A real numeric array by its name, in its own type.

    Raises ToftrackError: the file cannot be read, is damaged or of another version, or has no such
    array.
    """
    command = [sys.executable, "-c", _PROGRAM, name]
    done = subprocess.run(command, input=read_bytes(path), capture_output=True, check=False)
    if done.returncode != 0:
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        reason = last if done.returncode == 1 and last else "SciPy's reader crashes on it"
        raise ToftrackError(f"the file '{path}' cannot be used ({reason}); copy the data set again")
    return np.load(io.BytesIO(done.stdout), allow_pickle=False)


def _damaged(path: Path, what: str) -> ToftrackError:
    return ToftrackError(f"{_KEY} in the file '{path}' {what}; copy the data set again")


def _read_depth(path: Path) -> np.ndarray:
    """(480, 640) float32 metres."""
    image = read_png(path, np.uint8, (_HEIGHT, _WIDTH, 3))
    return metres(image[..., 1].astype(np.uint16) << 8 | image[..., 0])


NYU = DataSet(
    name="NYU",
    joints=(0, *sorted(_POINTS)),
    tip_inset_m=0.007,
    tips=(
        "a label of a finger's end is the middle of the last sphere of the authors' hand model, "
        "and the wrist the middle of its two ends"
    ),
    layout="there must be joint_data.mat and depth_1_0000001.png, also in a folder test",
    open=_open,
)
