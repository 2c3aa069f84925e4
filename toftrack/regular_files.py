"""Files that a user names: a pipe would be waited for without end, a device read without end."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


class NotRegularError(OSError):
    """What is named is a pipe, a device or a socket."""

    def __str__(self) -> str:
        return str(self.strerror)


def open_regular(path: str | Path) -> BinaryIO:
    """Open a file to read its bytes.

    Raises OSError, also where it is neither a file nor a link to one: that is never waited for.
    """
    check_regular(path)
    # What has taken its place since then is not waited for either.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    stream = open(path, "rb", opener=lambda name, _: os.open(name, flags))
    try:
        _check(os.fstat(stream.fileno()).st_mode, path)
    except BaseException:
        stream.close()
        raise
    return stream


def check_regular(path: str | Path) -> None:
    """For those who open a file by themselves, or all files in a folder: OSError for what is not
    one, or is not there."""
    _check(os.stat(path).st_mode, path)
    if os.path.isdir(path):
        for entry in os.scandir(path):
            if not entry.is_dir():
                _check(entry.stat().st_mode, entry.path)


def _check(mode: int, path: str | Path) -> None:
    kind = stat.S_IFMT(mode)
    if kind not in (stat.S_IFREG, stat.S_IFDIR):
        words = f"'{os.fspath(path)}' is {_KINDS.get(kind, 'no file')}, and only files are read"
        raise NotRegularError(errno.ENOTSUP, words, os.fspath(path))
