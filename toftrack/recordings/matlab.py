"""MATLAB's `.mat` up to version 7.2, read by SciPy in a process of its own: a damaged one can crash
it."""

from __future__ import annotations

import io
import json
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np

from toftrack.files.archives import MOST_BYTES
from toftrack.files.safe_files import open_to_read

_PROGRAM = f"""
import json, math, sys
import numpy
from scipy.io import loadmat, whosmat
file, names = sys.stdin.buffer, sys.argv[1:]
there = {{name: ([int(n) for n in shape], kind) for name, shape, kind in whosmat(file)}}
if not names:
    json.dump(there, sys.stdout)
    sys.exit()
(name,) = names
if name not in there:
    raise ValueError(f"it has no array named {{name}}")
shape, kind = there[name]
size = numpy.dtype(numpy.sctypeDict.get(kind, "f8")).itemsize
if size * math.prod(shape) > {MOST_BYTES}:
    raise ValueError("it is larger than a gigabyte: save it with -v7.3")
file.seek(0)
array = loadmat(file, variable_names=names)[name]
if getattr(array, "dtype", numpy.dtype(object)).kind not in "fiu":
    raise ValueError(f"{{name}} does not consist of real numbers")
numpy.save(sys.stdout.buffer, array, allow_pickle=False)
"""
"""Reads the file from standard input; writes what there is as JSON, or an array as `.npy`."""
_COMPRESSED = 15
"""Of the kinds of elements in a file."""


def matlab_variables(path: Path) -> dict[str, tuple[tuple[int, ...], str]]:
    """Shape and MATLAB's class of each variable, by name. Raises OSError; ValueError, a few words,
    where the file is damaged, of another version, or has a variable of more than a gigabyte.
    """
    there = json.loads(_said(path))
    return {name: (tuple(shape), kind) for name, (shape, kind) in there.items()}


def read_matlab(path: Path, name: str) -> np.ndarray:
    """A real numeric array by its name, in its own type. Raises as matlab_variables, and ValueError
    where there is no such array."""
    return np.load(io.BytesIO(_said(path, name)), allow_pickle=False)


def _said(path: Path, *name: str) -> bytes:
    try:
        _check_unpacked(path)
    except zlib.error as error:
        raise ValueError(str(error)) from None
    # -P: no modules of the folder that we are in.
    command = [sys.executable, "-P", "-c", _PROGRAM, *name]
    with open_to_read(path) as stream:
        done = subprocess.run(command, stdin=stream, capture_output=True, check=False)
    if done.returncode != 0:
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise ValueError(last if done.returncode == 1 and last else "SciPy's reader crashes on it")
    return done.stdout


def _check_unpacked(path: Path) -> None:
    """ValueError where a compressed variable is larger than anything that is read: SciPy makes
    room for what its header claims."""
    with open_to_read(path) as stream:
        order = "<" if stream.read(128)[126:] == b"IM" else ">"
        while len(tag := stream.read(8)) == 8:
            kind, size = struct.unpack(order + "II", tag)
            end, unpacked, unpack = stream.tell() + size, 0, zlib.decompressobj()
            while kind == _COMPRESSED and not unpack.eof:
                piece = stream.read(min(2**20, end - stream.tell()))
                if not piece:
                    break
                while piece:
                    unpacked += len(unpack.decompress(piece, 2**20))
                    piece = unpack.unconsumed_tail
                if unpacked > MOST_BYTES:
                    raise ValueError("a variable is larger than a gigabyte: save it with -v7.3")
            stream.seek(end)
