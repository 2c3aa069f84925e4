"""How numba's kernels are compiled: once on a machine, announced if it takes long, then cached."""

from __future__ import annotations

import logging
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

log = logging.getLogger(__name__)

OPTIONS = {"fastmath": {"contract", "arcp", "nsz"}, "nogil": True, "error_model": "numpy"}
"""nnan and ninf stay off: NaN is how a kernel learns that a square root missed."""
compiled = numba.njit(**OPTIONS, no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Decorator of the functions that entry points call."""

_SILENT_S = 1.0
"""Taking a kernel from numba's cache is faster than this, compiling it is slower."""
_compiling = threading.Lock()
_uncached = threading.Event()
"""There is no place to keep the machine code."""
_told = threading.Event()
"""And that was said."""
_HINT = (
    "compiled kernels cannot be kept, because neither installation nor home can be written; "
    "set NUMBA_CACHE_DIR to a folder of your own that can be"
)


def entry_point(*sources: str | Path | None) -> Callable:
    """Decorator of a kernel's entry points: compiled at the first call, or from the cache.

    sources: the files that the kernel is made of; a change in any of them compiles it anew.
    """
    # numba's cache notices changes of the function's own file only, but it does go by the name.
    files = [file for file in (__file__, *sources) if file is not None]
    checksum = zlib.crc32(b"".join(Path(file).read_bytes() for file in files))

    def decorator(function: Callable) -> Callable:
        function.__qualname__ += f"_{checksum:08x}"
        try:
            return numba.njit(cache=True, **OPTIONS)(function)
        except RuntimeError:  # there is no place to write to
            _uncached.set()
            return numba.njit(**OPTIONS)(function)

    return decorator


@intrinsic
def take(typingctx, counter):
    """counter[0] += 1, atomically; the value before. How threads share tasks."""

    def codegen(context, builder, signature, args):
        at = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", at, ir.IntType(64)(1), "monotonic")

    return types.int64(counter), codegen


@contextmanager
def announced(message: str) -> Iterator[None]:
    """Around the first call of an entry point: logs the message if compiling it takes long.

    Where the machine code cannot be cached, the first message is followed by what to do.
    Only one thread compiles at a time, so that the others do not compile the same once more.
    """
    with _compiling:
        timer = threading.Timer(_SILENT_S, _tell, (message,))
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()


def _tell(message: str) -> None:
    if not _uncached.is_set():
        log.info(message)
        return
    log.info(message.replace("(once", "(in every run"))
    if not _told.is_set():
        _told.set()
        log.info(_HINT)


def called(kernel: Any, message: str, *arguments: object) -> None:
    """Call an entry point; the message is logged if it must be compiled before."""
    if kernel.signatures:
        kernel(*arguments)
        return
    with announced(message):
        kernel(*arguments)
