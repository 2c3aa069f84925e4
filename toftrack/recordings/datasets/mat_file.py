"""Numeric arrays out of MATLAB's files of version 5 to 7, by SciPy.

SciPy's reader can crash on a damaged file, and so runs in a process of its own.
"""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.recordings.datasets.base import read_bytes

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
"""Reads the file from standard input and writes the array to standard output as `.npy`."""


def read_numbers(path: Path, name: str) -> np.ndarray:
    """A real numeric array by its name, in its own type.

    Raises:
        ToftrackError: the file cannot be read, is damaged or of another version, or has no such
            array.
    """
    command = [sys.executable, "-c", _PROGRAM, name]
    done = subprocess.run(command, input=read_bytes(path), capture_output=True, check=False)
    if done.returncode != 0:
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        reason = last if done.returncode == 1 and last else "SciPy's reader crashes on it"
        raise ToftrackError(f"the file '{path}' cannot be used ({reason}); copy the data set again")
    return np.load(io.BytesIO(done.stdout), allow_pickle=False)
