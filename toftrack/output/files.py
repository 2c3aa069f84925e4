"""Files that are either whole or as they were, and folders that only one run writes into."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from toftrack.errors import ToftrackError

try:
    import fcntl
except ImportError:  # Windows: there, two runs into one folder are not noticed
    fcntl = None  # type: ignore[assignment]

LINES = "track.jsonl"
"""The file of a run's folder that grows, and that is locked while it does."""
_BLOCK = 65536


def write_whole(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let `write` fill a binary stream; `path` changes only when all of it is on the disk.

    Raises OSError, after which `path` is as it was.
    """
    partial = path.with_name(path.name + ".part")
    try:
        with open(partial, "wb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(partial, path)
    finally:
        # A folder in its place was not made here; opening it has failed already.
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def save_whole(path: Path, save: Callable[[Path], object]) -> None:
    """As write_whole, for a function that writes a file of a given name by itself."""
    partial = path.with_name(path.name + ".part")
    try:
        save(partial)
        os.replace(partial, path)
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


class LineFile:
    """The growing file of a run's folder, which it locks: the folder has one writer at a time.

    A line is in the file as a whole or not at all, unless the process is killed within it. The lock
    goes with the process, however that ends.

    Args:
        folder: exists.
        keep: keep the lines that are there, but for one at the end that was not finished; otherwise
            the file is emptied.

    Raises:
        ToftrackError: another run is writing into the folder.
        OSError: the file cannot be opened, or (by `append`) not be written.
    """

    def __init__(self, folder: Path, keep: bool = False) -> None:
        self.path = folder / LINES
        descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
        self._file = io.FileIO(descriptor, "r+")
        try:
            self._lock()
            self._size = _size_of_lines(self._file) if keep else 0
            self._file.truncate(self._size)
            self._file.seek(self._size)
        except BaseException:
            self._file.close()
            raise

    def append(self, line: str) -> None:
        """Write a line, given without its end."""
        data = memoryview((line + "\n").encode())
        begin = self._size
        try:
            while data:  # a disk that is nearly full takes a part
                count = self._file.write(data)
                data = data[count:]
                self._size += count
        except BaseException:
            self._size = begin
            with suppress(OSError):
                self._file.truncate(begin)
                self._file.seek(begin)
            raise

    def close(self) -> None:
        """Close the file, which gives the folder free; a second call does nothing."""
        self._file.close()

    def _lock(self) -> None:
        if fcntl is None:
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ToftrackError(
                f"another run is writing into the folder '{self.path.parent}' just now; wait for "
                "its end, or choose another folder with hydra.run.dir=DIR"
            ) from None
        except OSError:
            pass  # some network file systems have no locks


def _size_of_lines(file: io.FileIO) -> int:
    """Bytes up to the end of the last whole line."""
    end = file.seek(0, os.SEEK_END)
    while end > 0:
        begin = max(0, end - _BLOCK)
        file.seek(begin)
        found = file.read(end - begin).rfind(b"\n")
        if found >= 0:
            return begin + found + 1
        end = begin
    return 0
