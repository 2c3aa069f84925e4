"""The images of a long `.npz` recording: read one after the other, never loaded as a whole."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import numpy as np

from toftrack.archives import Archive, Header
from toftrack.errors import ToftrackError
from toftrack.safe_files import open_to_read


class StreamedImages:
    """(T, H, W) images of one array of an archive, each to be had by its number.

    Made for going forward. An image before the latest one is found by beginning anew.

    Raises ToftrackError where the array cannot be read in turn, and later where it is damaged.
    """

    def __init__(self, path: Path, name: str, header: Header) -> None:
        self._path, self._name = path, name
        if header.fortran_order or header.kind.kind not in "fiu":
            raise ToftrackError(
                f"'{name}' of the recording '{path}' has {header.size / 1e9:.1f} GB, and can be "
                "read in turn only as numbers in C order; save it so (numpy.ascontiguousarray)"
            )
        self.shape, self.dtype, self.ndim = header.shape, header.kind, len(header.shape)
        self.size = int(np.prod(header.shape, dtype=object))
        self._images: Generator[np.ndarray] | None = None
        self._latest: tuple[int, np.ndarray] | None = None

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: int) -> np.ndarray:
        """(H, W), of the file's type."""
        if not 0 <= index < len(self):
            raise IndexError(index)
        if self._latest is None or index < self._latest[0]:
            self.close()
            self._images = self._in_turn()
        number, image = self._latest or (-1, np.empty(0))
        while number < index:
            assert self._images is not None
            number, image = number + 1, next(self._images)
            self._latest = number, image
        return image

    def close(self) -> None:
        """Close the file; the next image opens it again."""
        if self._images is not None:
            self._images.close()
        self._images = self._latest = None

    def _in_turn(self) -> Generator[np.ndarray]:
        shape = self.shape[1:]
        size = int(np.prod(shape)) * self.dtype.itemsize
        try:
            with open_to_read(self._path) as file, Archive(file).rows(self._name) as stream:
                for _ in range(len(self)):
                    content = stream.read(size)
                    if len(content) < size:
                        raise ValueError(f"{self._name!r} is cut off")
                    yield np.frombuffer(content, self.dtype).reshape(shape)
        except OSError as error:
            raise ToftrackError(
                f"the recording '{self._path}' cannot be read ({error.strerror or error})"
            ) from error
        except ValueError as error:
            raise ToftrackError(f"the recording '{self._path}' is damaged ({error})") from None


Images = np.ndarray | StreamedImages
"""(T, H, W) images, in memory or on the disk."""
