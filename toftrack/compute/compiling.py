"""How numba's kernels are compiled: once on a machine, which is announced, then cached.

Whatever is wrong with the cache costs compiling once more and a sentence in the log, never a run.
numba describes what it keeps by pickles, so only a folder is used that is closed to other users.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import logging
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import filelock
import llvmlite.binding as llvm
import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from toftrack.compute.collector import collector_paused
from toftrack.errors import ToftrackError

log = logging.getLogger(__name__)

OPTIONS: dict[str, Any] = {
    "fastmath": {"contract", "arcp", "nsz"},
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
}
"""nnan and ninf stay off: NaN is how a kernel learns that a square root missed."""

compiled: Any = numba.njit(**OPTIONS, no_cpython_wrapper=True)
"""Decorator of the functions that kernels call, and that Python cannot."""

_PATIENCE_S = 120.0
"""What another process does not finish in that time is compiled here as well: it may be stopped."""
_config: Any = numba.config
lock = threading.RLock()
"""Of the thread that compiles."""
_said: set[str] = set()


class Kernel:
    """A compiled function that Python calls: compiled, or taken from the cache, the first time."""

    def __init__(self, function: Callable, nogil: bool = False) -> None:
        functools.update_wrapper(self, function)
        self.function, self.options = function, OPTIONS | {"nogil": nogil}
        self.dispatcher: Any = None

    @property
    def is_compiled(self) -> bool:
        """Whether a call need not wait for the compiler."""
        return self.dispatcher is not None and bool(self.dispatcher.overloads)

    def __call__(self, *args: Any) -> Any:
        if self.is_compiled:
            return self._run(args)
        with lock, collector_paused():
            self.dispatcher = self.dispatcher or _cached(self.function, self.options)
            _announce(self.dispatcher)
            with _only_one_process(self.dispatcher.stats.cache_path):
                return self._run(args)

    def _run(self, args: tuple) -> Any:
        try:
            return self.dispatcher(*args)
        except Exception as error:  # whatever reading a damaged file may bring about
            runs = tuple(map(numba.typeof, args)) in self.dispatcher.overloads
            if isinstance(error, numba.errors.NumbaError) or (
                runs and not isinstance(error, OSError)
            ):
                raise
            _say_once(error)
            if runs:  # it could not be kept
                return self.dispatcher(*args)
        try:
            self.dispatcher.recompile()  # empties what numba has kept of it
            return self.dispatcher(*args)
        except OSError:
            self.dispatcher = numba.njit(**self.options)(self.function)
            return self.dispatcher(*args)


entry_point = Kernel
"""Decorator of the functions that Python calls. They keep the interpreter's lock, which they would
wait for longer than they run; long ones, and those that threads share, are shared_entry_point."""


shared_entry_point = functools.partial(Kernel, nogil=True)
"""Decorator of entry points that let go of the interpreter's lock meanwhile."""


@contextlib.contextmanager
def _only_one_process(cache_path: str | None) -> Iterator[None]:
    """What another process is compiling is waited for, and then loaded."""
    if not cache_path:
        yield
        return
    beside = filelock.FileLock(f"{cache_path}.lock", timeout=_PATIENCE_S)
    try:
        beside.acquire()
    except (OSError, NotImplementedError) as error:
        # No locks on this file system, or the other one took too long: both compile.
        log.debug(f"'{beside.lock_file}' cannot be locked ({error})")
    try:
        yield
    finally:
        beside.release()


def _cached(function: Callable, options: dict[str, Any]) -> Any:
    """numba's function with a cache, or without one where it cannot be trusted or written."""
    if _config.DISABLE_JIT:  # kernels have parts that only the compiler knows
        raise ToftrackError(
            "NUMBA_DISABLE_JIT keeps toftrack's kernels from being compiled; unset it"
        )
    before = _config.CACHE_DIR
    try:
        folder = _private_folder() / _fingerprint(function)
        _config.CACHE_DIR = str(folder)
        dispatcher = numba.njit(**options, cache=True)(function)
        if not Path(dispatcher.stats.cache_path).is_relative_to(folder):
            raise PermissionError(f"'{folder}' cannot be written")
        return dispatcher
    except (OSError, RuntimeError) as error:  # no home, no source file
        _say_once(error)
        return numba.njit(**options)(function)
    finally:
        _config.CACHE_DIR = before


def _private_folder() -> Path:
    """The folder of this user's kernels for this machine, made if need be. Raises OSError or
    RuntimeError.
    """
    given = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME", "")
    own = given if os.path.isabs(given) else Path.home() / ".cache"  # as its specification has it
    caches = _config.CACHE_DIR or own
    folder = Path(caches).absolute() / "toftrack" / "kernels"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = os.stat(folder)
    # Windows does not say it so.
    if hasattr(os, "geteuid") and (found.st_uid != os.geteuid() or found.st_mode & 0o077):
        raise PermissionError(f"'{folder}' must belong to this user and be closed to others")
    of_machine = folder / _machine()
    of_machine.mkdir(mode=0o700, exist_ok=True)
    return of_machine


@functools.cache
def _machine() -> str:
    """What kernels are compiled for and by: a home may be shared, an image run elsewhere."""
    name = _config.CPU_NAME or llvm.get_host_cpu_name()
    features = _config.CPU_FEATURES or llvm.get_host_cpu_features().flatten()
    return hashlib.sha256(f"{numba.__version__} {name} {features}".encode()).hexdigest()[:8]


def nothing_kept() -> bool:
    """Whether this user has never had a kernel compiled here, as far as can be seen."""
    try:
        return not any(_private_folder().iterdir())
    except (OSError, RuntimeError):
        return False


def _fingerprint(function: Callable) -> str:
    """Of all that a kernel is made of: numba notices only what changes in the kernel's own file.

    These are the files of the functions that it calls, and the constants that these read.
    """
    digest = hashlib.sha256()
    left, known = [function], set()
    while left:
        part = inspect.unwrap(left.pop())
        if part in known:
            continue
        known.add(part)
        digest.update(_content(inspect.getfile(part)))
        captured = inspect.getclosurevars(part)
        for _, value in sorted({**captured.globals, **captured.nonlocals}.items()):
            if hasattr(value, "__wrapped__") or inspect.isfunction(value):
                left.append(value)
            elif inspect.ismodule(value) and hasattr(value, "__file__"):
                digest.update(_content(value.__file__))
            else:
                raw = value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
                digest.update(raw)
    return digest.hexdigest()[:16]


@functools.cache
def _content(file: str) -> bytes:
    return Path(file).read_bytes()


def _say_once(error: Exception) -> None:
    """A sentence a process on why kernels are compiled anew."""
    if "cache" not in _said:
        _said.add("cache")
        log.warning(
            f"compiled kernels cannot be kept, or what was kept is damaged ({error}), so that they "
            "are compiled anew; if every run says so, set NUMBA_CACHE_DIR to a folder of your own"
        )


def _announce(dispatcher: Any) -> None:
    """Say once a process that a kernel is compiled, unless it is only loaded."""
    folder = dispatcher.stats.cache_path
    if "compiling" not in _said and not (folder and os.listdir(folder)):
        _said.add("compiling")
        often = "once on a machine" if folder else "in every run"
        log.info(f"compiling kernels ({often}, for up to a minute)")


if hasattr(os, "register_at_fork"):
    # What another thread compiles is finished first: a lock that it holds would never be released
    # in the forked process, which has no such thread.
    os.register_at_fork(
        before=lock.acquire,
        after_in_parent=lock.release,
        after_in_child=lock.release,
    )


@intrinsic
def take(typingctx, counter):
    """counter[0] += 1, atomically; the value before. How threads share tasks."""

    def codegen(context, builder, signature, args):
        at = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", at, ir.IntType(64)(1), "monotonic")

    return types.int64(counter), codegen
