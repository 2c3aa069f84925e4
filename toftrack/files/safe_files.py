"""Opening files: what is written is ours, what is read is a file.

A folder that somebody else made may hold anything under the names that are written there: symbolic
links, second names (hard links) of files elsewhere, pipes, devices. Nothing is written through any
of them. A file becomes new under another name and then takes its place, so that what stood there is
whole until then; only what must grow in place is opened in place, when it has no other name.

A folder on the way to a file may be a link: which folder is meant, the user says. What cannot be
opened or written, or is of another kind, is an OSError.
"""

from __future__ import annotations

import errno
import io
import os
import re
import secrets
import stat
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from io import RawIOBase
from pathlib import Path
from typing import IO, BinaryIO

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_BINARY = getattr(os, "O_BINARY", 0)
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
_NO_WAIT = getattr(os, "O_NONBLOCK", 0)
"""Opening a pipe otherwise waits for its other end."""
_PARTIAL = ".part"
_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


_kept: dict[str, int] = {}
"""The descriptors of the folders that `lock_folder` has locked, by their absolute paths."""


class _NoFileError(OSError):
    """What is named is a pipe, a device or a socket."""

    def __str__(self) -> str:
        return str(self.strerror)


def open_to_read(path: str | Path) -> BinaryIO:
    """Open a file, also through a link; a pipe is refused, and never waited for."""
    _refuse(path, os.stat(path))  # before it is opened, which does something to some devices
    descriptor = os.open(path, os.O_RDONLY | _BINARY | _NO_WAIT)
    try:
        _refuse(path, os.fstat(descriptor))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def check_readable(path: str | Path) -> None:
    """For those who open a file by themselves, or all files in a folder: raise OSError for what is
    no file, or is not there.
    """
    if not os.path.isdir(path):
        _refuse(path, os.stat(path))
        return
    for entry in os.scandir(path):
        if not entry.is_dir():
            _refuse(entry.path, entry.stat())


def open_new(path: str | Path, replace: bool = False, buffered: bool = True) -> BinaryIO:
    """Make a file where nothing stands, open for writing and reading.

    replace: let a file that stands there go; its other names, if any, keep what is in it.
    buffered: False: what is written reaches the operating system at once; `write` may take a part.
    """
    if replace:
        check_replaceable(path)
        Path(path).unlink(missing_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | _BINARY, 0o666)
    return os.fdopen(descriptor, "w+b", -1 if buffered else 0)


def open_in_place(path: str | Path, make: bool = True) -> io.FileIO:
    """Open a file of ours to change it, no link and without a second name, without buffer; what is
    in it stays. Where there is none, make an empty one.
    """
    flags = os.O_RDWR | (os.O_CREAT if make else 0) | _NO_LINK | _NO_WAIT | _BINARY
    if not _NO_LINK:  # Windows
        check_replaceable(path)
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError:
        check_replaceable(path)  # which says more than "too many levels of symbolic links"
        raise
    try:
        status = os.fstat(descriptor)
        _refuse(path, status)
        if status.st_nlink > 1:
            why = "it has a second name elsewhere (a hard link), where it would change, too"
            raise OSError(errno.EMLINK, why, str(path))
        return io.FileIO(descriptor, "r+b")
    except BaseException:
        os.close(descriptor)
        raise


def write_on(stream: IO[bytes] | RawIOBase, size: int, *parts: bytes) -> int:
    """Write bytes at the end of a file of that size, which has no buffer; returns its size then.
    After an error the file is as it was.
    """
    try:
        for part in parts:
            rest = memoryview(part)
            while rest:  # a disk that is nearly full takes a part
                rest = rest[stream.write(rest) :]
    except BaseException:
        with suppress(OSError):  # whoever reads it copes with a record that is cut off
            stream.truncate(size)
            stream.seek(size)
        raise
    return size + sum(map(len, parts))


def lock(stream: IO[bytes] | RawIOBase | int) -> None:
    """Have a file, or the folder of a descriptor, for oneself among those who ask, until it is
    closed; Windows grants it to all.

    Raises BlockingIOError while another process has it.
    """
    if fcntl is None:
        return
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        pass  # some network file systems have no locks


def lock_folder(path: str | Path) -> int | None:
    """Make a folder where there is none, and have it for oneself until `leave_folder`; meanwhile,
    what takes its place is not written into.

    None on Windows, which locks no folders. Raises BlockingIOError while another process has it,
    and OSError.
    """
    while True:
        Path(path).mkdir(parents=True, exist_ok=True)
        if fcntl is None:
            return None
        descriptor = os.open(path, os.O_RDONLY)
        try:
            lock(descriptor)
            if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                _kept[os.path.abspath(path)] = descriptor
                return descriptor
        except FileNotFoundError:
            pass  # whoever had it before took it away, and so what is locked is none any more
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def leave_folder(descriptor: int) -> None:
    """Give a folder free that `lock_folder` has locked."""
    for path in [path for path, kept in _kept.items() if kept == descriptor]:
        del _kept[path]
    os.close(descriptor)


def _check_kept(path: str | Path) -> None:
    """OSError where another folder, or a link to one, has taken the place of a file's folder."""
    folder = os.path.dirname(os.path.abspath(path))
    kept = _kept.get(folder)
    if kept is not None and not os.path.samestat(os.fstat(kept), os.stat(folder)):
        why = "another folder has taken its place; what was written before is where it was moved to"
        raise OSError(errno.ESTALE, why, folder)


@contextmanager
def whole_file(path: str | Path) -> Iterator[BinaryIO]:
    """A stream, open for writing and reading; `path` changes when all of it is on the disk, and
    after an error is as it was.
    """
    path = Path(path)
    check_replaceable(path)
    # Of a long name the beginning: the whole one leaves no room for an ending.
    partial = path.with_name(f"{path.name[:50]}.{secrets.token_hex(4)}{_PARTIAL}")
    stream = open_new(partial)
    try:
        with stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        _check_kept(path)  # that may have been long ago
        os.replace(partial, path)
    except BaseException:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


def write_whole(path: str | Path, content: bytes | str) -> None:
    """Write a file, text in UTF-8; it is there as a whole, or as it was."""
    with whole_file(path) as stream:
        stream.write(content.encode() if isinstance(content, str) else content)


def remove_partial(folder: Path, names: Collection[str]) -> None:
    """Remove what killed `whole_file`s of these names left. Nobody may be writing them just now."""
    mark = len(".") + 8 + len(_PARTIAL)
    with suppress(OSError):
        for found in folder.iterdir():
            if found.name[:-mark] in names and found.name.endswith(_PARTIAL):
                found.unlink()


def let_links_go(path: Path) -> None:
    """Remove, under a name that another library will write, a link, a second name or a pipe; what
    they lead to stays.
    """
    with suppress(FileNotFoundError):
        status = os.lstat(path)
        alone = stat.S_ISREG(status.st_mode) and status.st_nlink == 1
        if not alone and not stat.S_ISDIR(status.st_mode):
            path.unlink()


def make_folder(path: str | Path) -> None:
    """Make a folder in one that may be somebody else's; a link to one is refused."""
    if Path(path).is_symlink():
        raise OSError(errno.ELOOP, "it is a symbolic link; take it away", str(path))
    Path(path).mkdir(parents=True, exist_ok=True)


def check_replaceable(path: str | Path) -> None:
    """Raise OSError where something stands that is no file, or the link to one."""
    _check_kept(path)
    with suppress(FileNotFoundError):
        _refuse(path, os.lstat(path))


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """Sorts names of files with numbers in them by value: 2 before 10."""
    # By length, then by digits: Python makes no numbers of thousands of them.
    parts = re.findall(r"0*([0-9]+)|([^0-9]+)", name)
    return [(0, len(digits), digits) if digits else (1, 0, other) for digits, other in parts]


def _refuse(path: str | Path, status: os.stat_result) -> None:
    """OSError for what is no file."""
    if stat.S_ISREG(status.st_mode):
        return
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if stat.S_ISLNK(status.st_mode):
        why = "it is a symbolic link, and nothing is written through one; take it away"
        raise OSError(errno.ELOOP, why, str(path))
    kind = _KINDS.get(stat.S_IFMT(status.st_mode), "no file")
    raise _NoFileError(errno.EINVAL, f"it is {kind}, and only files are read or written", str(path))
