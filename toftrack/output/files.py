"""A run's folder: its growing file, the lock on it, and what of an earlier run may go."""

from __future__ import annotations

import errno
import logging
import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from toftrack.errors import MOST_HANDS, ToftrackError
from toftrack.files.json_text import read_json, read_object
from toftrack.files.safe_files import (
    check_replaceable,
    lock,
    lock_folder,
    open_in_place,
    open_to_read,
    remove_partial,
    write_on,
)

_log = logging.getLogger(__name__)

LINES = "track.jsonl"
"""The file of a run's folder that grows, and that is locked while it does."""
_SHAPES = tuple(f"hand_shape_{slot}.json" for slot in range(2, MOST_HANDS + 1))
"""Of all slots but the first, whose file every run writes."""
WHOLE_FILES = (
    *("run.json", "track.npz", "summary.json", "overlay.png"),
    *("hand_shape.json", *_SHAPES),
)
"""Those that take their place when they are done, and of which a kill may leave a part."""
RUN_FORMAT = "toftrack-run"
"""What the run.json of a run's folder says that it is."""


class LineFile:
    """The growing file of a run's folder, which it locks: the folder has one writer at a time.

    A line is in the file as a whole or not at all, unless the process is killed within it. The lock
    goes with the process, however that ends. What was in the file stays there until `clear`.

    Raises ToftrackError: another run is writing into the folder; OSError: the file cannot be
    opened, or (by `append`) not be written.
    """

    def __init__(self, folder: Path) -> None:
        self.path, self._size = folder / LINES, 0
        self._file = open_in_place(self.path)
        try:
            with _one_writer(folder):
                lock(self._file)
        except BaseException:
            self._file.close()
            raise

    def clear(self) -> None:
        """Begin with an empty file. Raises OSError."""
        self._file.truncate(0)

    def append(self, line: str) -> None:
        """Write a line, given without its end."""
        # Whoever removed it removes all that is written from now on.
        if not os.fstat(self._file.fileno()).st_nlink and not self.path.exists():
            raise FileNotFoundError(errno.ENOENT, f"its {LINES} was removed", str(self.path))
        self._size = write_on(self._file, self._size, (line + "\n").encode())

    def close(self) -> None:
        """Close the file, which gives the folder free; a second call does nothing."""
        self._file.close()


@contextmanager
def locked_lines(folder: Path) -> Iterator[None]:
    """Keep a folder for oneself that has a growing file; nothing in that file is changed.

    Raises ToftrackError where a run is writing into the folder, OSError where the file is none.
    """
    check_replaceable(folder / LINES)
    with open_to_read(folder / LINES) as file:
        with _one_writer(folder):
            lock(file)
        yield


def cut_unfinished_line(folder: Path) -> None:
    """Take from the growing file's end the line that was not finished; one of its lines is ours.

    A file with a second name elsewhere stays as it is. Raises OSError.
    """
    if (folder / LINES).stat().st_nlink > 1:
        return
    with open_in_place(folder / LINES, make=False) as file:
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as lines:
            whole = lines.rfind(b"\n") + 1
        file.truncate(whole)


def own_folder(folder: Path) -> int | None:
    """`lock_folder` of a run's folder, which comes before anything is written there.

    Raises ToftrackError where a run is writing into the folder, and OSError.
    """
    with _one_writer(folder):
        return lock_folder(folder)


@contextmanager
def _one_writer(folder: Path) -> Iterator[None]:
    try:
        yield
    except BlockingIOError:
        raise ToftrackError(
            f"another run is writing into the folder '{folder}' just now; wait for its end, or "
            "choose another folder with hydra.run.dir=DIR (for a sweep: hydra.sweep.dir=DIR)"
        ) from None


def make_way(folder: Path) -> None:
    """Let the results of an earlier run go; ToftrackError where it is not clear that they are.

    Raises OSError, too.
    """
    ends = ("track.npz", "summary.json")
    replaced = read_object(folder / "run.json").get("format") == RUN_FORMAT
    if not replaced:
        for name in (LINES, *ends):
            if not _may_go(folder / name):
                raise ToftrackError(
                    f"'{folder}' has a {name}, but no run.json to show that a run made it; move "
                    "it away, or choose another folder with hydra.run.dir=DIR"
                )
    for name in ends:
        check_replaceable(folder / name)
        (folder / name).unlink(missing_ok=True)
    if replaced:
        for name in ("overlay.mp4", "overlay.png", *_SHAPES):  # which this run may not write
            if (folder / name).is_file():
                (folder / name).unlink()
        _log.warning("an earlier run in '%s' is replaced; exports and figures of it stay", folder)
    remove_partial(folder, WHOLE_FILES)


def _may_go(path: Path) -> bool:
    """Whether there is nothing, or what a run leaves that ended before it had a run.json."""
    try:
        if path.stat().st_size == 0:
            return True
        content = read_json(path)
    except FileNotFoundError:
        return True
    except (OSError, ValueError):
        return False
    return path.suffix == ".json" and isinstance(content, dict) and set(content) == {"error"}
