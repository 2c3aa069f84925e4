"""Stacks of bare depth images in one file: `.npy`, `.tif`, `.h5` and `.mat`.

Frames come first where a program keeps the last axis together (NumPy, HDF5), and last in MATLAB;
the camera, where it tells another size of the images, decides.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError, module_of_extra, reported_errors
from toftrack.files.archives import MOST_BYTES
from toftrack.files.safe_files import open_to_read
from toftrack.recordings.bare import (
    MILLIMETRE,
    Given,
    bare_camera,
    check_metres,
    metres_of,
    size_of,
)
from toftrack.recordings.frame_store import DEFAULT_FPS, FrameStore, file_of, reading
from toftrack.recordings.images import decoded, pages_of, tiff_of_page
from toftrack.recordings.matlab import matlab_variables, read_matlab

_PYTHONS, _MATLABS, _REVERSED = (0, 1, 2), (2, 0, 1), (0, 2, 1)
"""Which axes are frames, rows and columns; the last is MATLAB's as HDF5 sees it."""
_NUMBERS = ("double", "single", *(f"{s}int{n}" for s in ("", "u") for n in (8, 16, 32, 64)))
"""MATLAB's classes of numbers."""
_LEAST_PX = 64
"""Of a side of an image; what is narrower, beside a cell, may be boxes or joints of each frame."""
_MOST_NESTED = 32
"""Groups of HDF5: each is looked up from the first one on."""
_MOST_RATIO, _SMALL_BYTES, _MOST_CHUNK_BYTES = 1000, 2**26, 2**28
"""As in `archives`: what shrank more was made to fill memories."""


class Stack(FrameStore):
    """The frames of a stack, mostly from the disk as long as this object lives; its kind follows
    from its name.

    given: a lens, or camera.json lies beside the file; the unit of whole numbers (a millimetre) and
    the frame rate (25); of a `.h5` or `.mat` that has several, the dataset.
    """

    unit_m: float

    def __init__(self, path: Path, given: Given) -> None:
        self.path = file_of(path)
        images, order = _OPENED[path.suffix.lower()](path, given.dataset)
        if len(images.shape) != 3 or 0 in images.shape or images.dtype.kind not in "uif":
            raise ToftrackError(
                f"'{path}' has the shape {images.shape} of {images.dtype}, but must be depth "
                "images, (frames, rows, columns) of numbers"
            )
        size = None if images.shape[0] == 1 else size_of(path, given)
        if size is not None and path.suffix.lower() in DATASETS:

            def misfit(order: tuple[int, ...]) -> float:
                height, width = (images.shape[axis] for axis in order[1:])
                return float(np.abs(np.log((width, height) / size)).sum())

            order = min(order, _PYTHONS, _MATLABS, _REVERSED, key=misfit)
        count, height, width = (images.shape[axis] for axis in order)
        self.camera = bare_camera(path, given, width, height)
        self.unit_m = given.unit_m or (MILLIMETRE if images.dtype.kind in "ui" else 1.0)
        self.fps = given.fps or DEFAULT_FPS
        self.timestamp_s = np.arange(count) / self.fps
        self.metadata = {} if given.dataset is None else {"dataset": given.dataset}
        self._images, self._order = images, order
        some = [self.image(i)[0] for i in np.unique(np.linspace(0, count - 1, 8).astype(int))]
        check_metres(np.stack(some), f"'{path}'")

    def image(self, index: int) -> tuple[np.ndarray, None]:
        at: list[Any] = [slice(None)] * 3
        at[self._order[0]] = index
        with _reported(self.path, f"frame {index} of "):
            image = np.asarray(self._images[tuple(at)])
        depth = metres_of(image, self.unit_m)
        return (depth.T.copy() if self._order[1] > self._order[2] else depth), None

    def close(self) -> None:
        if isinstance(self._images, _Hdf5):
            self._images.close()


@contextmanager
def _reported(path: Path, what: str = "") -> Iterator[None]:
    """Whatever a library says of a damaged file becomes one sentence; they raise all kinds."""
    what, remedy = f"{what}'{path}' cannot be read", "it is damaged, or of another kind"
    with reported_errors(what, remedy, Exception), reading(path):
        yield


def _npy(path: Path, _: str | None) -> tuple[Any, tuple[int, ...]]:
    with _reported(path):
        try:
            images = np.lib.format.open_memmap(path, mode="r")
        except ValueError:  # NumPy's words may advise to trust the file
            raise ValueError("its header is damaged, or it holds Python objects") from None
        stacked = images[None] if images.ndim == 2 else images
        if stacked.flags.c_contiguous:
            return _Npy(path, stacked, images.offset), _PYTHONS
        # An image's numbers lie all over the file.
        if images.nbytes > MOST_BYTES:
            raise ValueError("it is larger than a gigabyte: save it with numpy.ascontiguousarray")
        with open_to_read(path) as stream:
            return np.load(stream, allow_pickle=False).reshape(stacked.shape), _PYTHONS


class _Npy:
    """The images of a .npy, read rather than mapped: one that shrinks would end the process."""

    def __init__(self, path: Path, mapped: np.ndarray, offset: int) -> None:
        self.shape, self.dtype = mapped.shape, mapped.dtype
        self._path, self._offset = path, offset

    def __getitem__(self, at: tuple[Any, ...]) -> np.ndarray:
        size = math.prod(self.shape[1:])
        begin = self._offset + int(at[0]) * size * self.dtype.itemsize
        with open_to_read(self._path) as stream:
            return np.fromfile(stream, self.dtype, size, offset=begin).reshape(self.shape[1:])


class _Tiff:
    """The images of a TIFF; as an array of three axes."""

    def __init__(self, path: Path) -> None:
        with _reported(path), open_to_read(path) as stream:
            pages = pages_of(stream)
            if not pages or not pages[0].is_depth or len(set(pages)) > 1:
                raise ValueError("its images are not grey, of one size, and of 16 bits or floats")
        self._path, self._pages = path, pages
        self.shape = (len(pages), pages[0].height, pages[0].width)
        self.dtype = np.dtype(pages[0].kind)

    def __getitem__(self, at: tuple[Any, ...]) -> np.ndarray:
        with open_to_read(self._path) as stream:
            content = tiff_of_page(stream, self._pages[int(at[0])])
        found = decoded(content)
        if found is None or found.shape != self.shape[1:]:
            raise ValueError("OpenCV cannot decode it")
        return found


def _chosen(path: Path, wanted: str | None, there: dict[str, tuple[int, ...]]) -> str:
    """The dataset of that name, or the only one; ToftrackError, with those there are."""
    names = [n for n in there if wanted is None or n.strip("/") == wanted.strip("/")]
    if len(names) == 1:
        return names[0]
    listed = ", ".join(f"{name} {shape}" for name, shape in list(there.items())[:12])
    which = "several arrays of images" if wanted is None else f"no array of images '{wanted}'"
    raise ToftrackError(
        f"'{path}' has {which if there else 'no array of images'}; choose one with "
        f"device.dataset=NAME (toftrack convert: --dataset): {listed or 'there is none'}"
    )


class _Hdf5:
    """A dataset of an HDF5 file, as an array of three axes; it is opened when it is needed.

    A chunk holds a part of many images, the more the longer the stack is, and is unpacked as a
    whole: as many images are read at a time.
    """

    def __init__(self, path: Path, wanted: str | None) -> None:
        self._h5py: Any = module_of_extra("h5py", f"'{path}' is read by h5py", "hdf5")
        self._path, self._file = path, None
        self._latest: tuple[tuple[int, int], np.ndarray] | None = None
        """Which axis, of what number on; and what was read there."""
        there: dict[str, Any] = {}

        def note(name: str, found: Any) -> None:
            if name.count("/") > _MOST_NESTED:
                raise ValueError("its groups are nested too deeply")
            # Hard links only: nothing outside of this file is opened.
            if isinstance(found, self._h5py.Dataset) and not (found.is_virtual or found.external):
                if found.dtype.kind in "uif" and len(found.shape or ()) in (2, 3):
                    there[name] = found.shape

        with _reported(path):
            self._file = self._h5py.File(path, "r")
            self._file.visititems(note)
            self._name = _chosen(path, wanted, there)
            found = self._file[self._name]
            stored, chunk = found.id.get_storage_size(), math.prod(found.chunks or (1,))
            if found.nbytes > max(_SMALL_BYTES, _MOST_RATIO * stored) or (
                max(chunk, math.prod(found.shape[-2:])) * found.dtype.itemsize > _MOST_CHUNK_BYTES
            ):
                raise ValueError(f"it would unpack {stored} bytes to {found.nbytes / 1e6:.0f} MB")
            self.shape = (1, *found.shape)[-3:]
            self.dtype = found.dtype

    def __getitem__(self, at: tuple[Any, ...]) -> np.ndarray:
        if self._file is None:
            self._file = self._h5py.File(self._path, "r")
        found = self._file[self._name]
        if found.ndim < 3 or found.chunks is None:
            return found[at[-found.ndim :]]
        axis = next(axis for axis, one in enumerate(at) if not isinstance(one, slice))
        image_bytes = found.nbytes // found.shape[axis]
        count = max(1, min(found.chunks[axis], _SMALL_BYTES // image_bytes))
        begin = int(at[axis]) // count * count
        if self._latest is None or self._latest[0] != (axis, begin):
            some = *at[:axis], slice(begin, begin + count), *at[axis + 1 :]
            self._latest = (axis, begin), found[some]
        return self._latest[1].take(int(at[axis]) - begin, axis)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = self._latest = None


def _mat(path: Path, wanted: str | None) -> tuple[Any, tuple[int, ...]]:
    with reading(path), open_to_read(path) as stream:
        if stream.read(10) == b"MATLAB 7.3":
            return _Hdf5(path, wanted), _REVERSED
    with _reported(path):
        variables = matlab_variables(path)
        there = {
            name: shape
            for name, (shape, kind) in variables.items()
            if kind in _NUMBERS and len(shape) in (2, 3) and min(shape) > 0 and max(shape) > 1
        }
        images = any(len(shape) == 3 or min(shape) >= _LEAST_PX for shape in there.values())
        for name, (_, kind) in variables.items():
            if kind == "cell" and (name == wanted or (wanted is None and not images)):
                raise ToftrackError(
                    f"'{path}': {name} is a cell, which is not read; save its images as one array, "
                    f"cat(3, {name}{{:}}), and give that"
                )
        array = read_matlab(path, _chosen(path, wanted, there))
    return (array[None], _PYTHONS) if array.ndim == 2 else (array, _MATLABS)


_OPENED = {
    ".npy": _npy,
    ".tif": lambda path, _: (_Tiff(path), _PYTHONS),
    ".tiff": lambda path, _: (_Tiff(path), _PYTHONS),
    ".h5": lambda path, wanted: (_Hdf5(path, wanted), _PYTHONS),
    ".hdf5": lambda path, wanted: (_Hdf5(path, wanted), _PYTHONS),
    ".mat": _mat,
}
DATASETS = (".h5", ".hdf5", ".mat")
"""How the names of files end that may hold several arrays."""
STACKS = frozenset(_OPENED)
