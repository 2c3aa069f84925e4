"""Where compiled kernels are kept from run to run: a folder of the user's, a file a kernel.

Whatever is wrong with that folder, or with what is in it, costs compiling once more and a sentence
in the log, never a run. A kernel is executed, and numba describes it by a pickle, so only files are
read that this user or the administrator wrote and nobody else could write.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import pickle
import stat
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core.compiler import CompileResult
from numba.core.registry import cpu_target
from numba.core.serialize import dumps

log = logging.getLogger(__name__)

_FORMAT = b"toftrack kernel 1\n"
_DIGEST_BYTES = 32
_KEPT = 16
"""Files of one function: of other versions, processors and types of arguments."""
_ABANDONED_S = 3600.0
"""Age of a file that nobody will finish writing."""
_ADVICE = "set NUMBA_CACHE_DIR to a folder of your own that can be written"
_said: set[str] = set()


class KernelCache:
    """Keeps the machine code of one function; numba's dispatchers take it for a cache of theirs."""

    def __init__(self, name: str) -> None:
        """name: of the function, another one whenever its code is another."""
        self.name = name.replace("<", "").replace(">", "")

    @property
    def cache_path(self) -> str:
        """For numba's statistics."""
        return str(cache_folder() or "")

    def is_kept(self) -> bool:
        """Whether there is code for this machine, for any types."""
        folder = usable_folder()
        return folder is not None and any(folder.glob(f"{self.name}-{_machine()}-*.kernel"))

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """numba's compilation for a signature; None where it must be compiled."""
        target_context.refresh()
        folder = usable_folder()
        if folder is None:
            return None
        try:
            described = _content(folder / self._file(sig))
            if described is None:
                return None
            return CompileResult._rebuild(target_context, *pickle.loads(described))
        except Exception as error:  # whatever a damaged file may bring about
            _say_once("damaged", f"a compiled kernel in '{folder}' {_why(error)}: compiled anew")
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compilation of numba's, if that is possible."""
        folder = usable_folder()
        if folder is None or data.lifted or data.library.has_dynamic_globals:
            return
        try:
            described = dumps(data._reduce())
            digest = hashlib.sha256(described).digest()
            _write(folder / self._file(sig), _FORMAT + digest + described)
            self._tidy(folder)
        except Exception as error:  # a full disk, a folder that cannot be written
            _say_once(
                "unkept",
                f"a compiled kernel cannot be kept, for '{folder}' {_why(error)}, so that every "
                f"run compiles it; {_ADVICE}",
            )

    def enable(self) -> None:
        """Part of what numba asks of a cache; it cannot be switched off."""

    disable = flush = enable

    def _file(self, sig: Any) -> str:
        return f"{self.name}-{_machine()}-{_short(sig)}.kernel"

    def _tidy(self, folder: Path) -> None:
        """Remove what older versions left of this function, and what was never finished."""
        with contextlib.suppress(OSError):
            files = folder.glob(f"{self.name.rpartition('_')[0]}_*.kernel")
            old = sorted(files, key=lambda file: -file.stat().st_mtime)[_KEPT:]
            before = time.time() - _ABANDONED_S
            old += [file for file in folder.glob("*.part") if file.stat().st_mtime < before]
            for file in old:
                file.unlink()


def can_be_kept() -> bool:
    """Whether compiled code can be kept, as far as is known before it is tried."""
    folder = usable_folder()
    return folder is not None and "unkept" not in _said and os.access(folder, os.W_OK | os.X_OK)


def cache_folder() -> Path | None:
    """Where the user's kernels are; None where the user has no home."""
    own = getattr(numba.config, "CACHE_DIR", "")
    if own:
        return Path(own).absolute() / "toftrack"
    given = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME", "")
    try:
        if sys.platform == "darwin":
            caches = Path.home() / "Library" / "Caches"
        elif os.path.isabs(given):
            caches = Path(given)
        else:
            caches = Path.home() / ("AppData/Local" if os.name == "nt" else ".cache")
    except RuntimeError:
        return None
    return caches / "toftrack" / "kernels"


def usable_folder() -> Path | None:
    """The folder, made if need be; None where it cannot be, or others could have written it."""
    folder = cache_folder()
    if folder is None:
        _say_once("unkept", f"compiled kernels cannot be kept: there is no home folder; {_ADVICE}")
        return None
    return _usable(folder)


@functools.cache
def _usable(folder: Path) -> Path | None:
    """Judged once a process."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _refuse_foreign(os.stat(folder))
    except (OSError, _RefusedError) as error:
        _say_once(
            "unkept",
            f"compiled kernels are neither read nor kept, for '{folder}' {_why(error)}, so that "
            f"every run compiles them; {_ADVICE}",
        )
        return None
    return folder


class _RefusedError(Exception):
    """Why a file or a folder is not used, as a part of a sentence."""


def _refuse_foreign(found: os.stat_result) -> None:
    """Raises _RefusedError when somebody else could have written it. Windows does not say."""
    if not hasattr(os, "geteuid"):
        return
    if found.st_uid not in (os.geteuid(), 0):
        raise _RefusedError("belongs to another user")
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise _RefusedError("can be written by other users")


def _content(path: Path) -> bytes | None:
    """What was kept in a file, None where there is none. Raises OSError or _RefusedError."""
    # Neither a link nor a pipe is ours, and opening the latter would wait for a writer.
    flags = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"))
    try:
        number = os.open(path, os.O_RDONLY | flags)
    except FileNotFoundError:
        return None
    with open(number, "rb") as file:
        found = os.fstat(number)
        if not stat.S_ISREG(found.st_mode):
            raise _RefusedError("is no file")
        _refuse_foreign(found)
        content = file.read()
    start = len(_FORMAT) + _DIGEST_BYTES
    digest, described = content[len(_FORMAT) : start], content[start:]
    if content[: len(_FORMAT)] != _FORMAT or hashlib.sha256(described).digest() != digest:
        raise _RefusedError("is damaged")
    return described


def _write(path: Path, content: bytes) -> None:
    """A file that is whole or not there, also where two processes write it."""
    number, part = tempfile.mkstemp(suffix=".part", dir=path.parent)
    try:
        with open(number, "wb") as file:
            file.write(content)
        os.replace(part, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(part)
        raise


@functools.cache
def _machine() -> str:
    """For which processor, by which compiler."""
    codegen = cpu_target.target_context.codegen()
    python = sys.implementation.cache_tag
    return _short((numba.__version__, llvmlite.__version__, python, codegen.magic_tuple()))


def _short(value: object) -> str:
    return hashlib.sha256(repr(value).encode()).hexdigest()[:16]


def _why(error: Exception) -> str:
    if isinstance(error, OSError):
        return f"cannot be used ({error.strerror or error})"
    return (
        str(error) if isinstance(error, _RefusedError) else f"is damaged ({type(error).__name__})"
    )


def _say_once(kind: str, sentence: str) -> None:
    if kind not in _said:
        _said.add(kind)
        log.warning(sentence)
