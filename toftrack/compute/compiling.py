"""How numba's kernels are compiled: once on a machine, announced if it takes long, then cached."""

from __future__ import annotations

import logging
import os
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.compiler_lock import global_compiler_lock
from numba.extending import intrinsic, register_jitable
from numba.np import arrayobj

from toftrack.compute.kernel_cache import KernelCache, can_be_kept
from toftrack.compute.quick_typing import quick_typing
from toftrack.compute.whole_kernels import as_kernel, is_part

log = logging.getLogger(__name__)

OPTIONS = {"fastmath": {"contract", "arcp", "nsz"}, "nogil": True, "error_model": "numpy"}
"""nnan and ninf stay off: NaN is how a kernel learns that a square root missed."""
_part = numba.njit(**OPTIONS, no_cpython_wrapper=True, no_cfunc_wrapper=True)

_SILENT_S = 1.0
"""Taking a kernel from numba's cache is faster than this, compiling it is slower."""
_compiling = threading.RLock()


def compiled(function: Callable) -> Any:
    """Decorator of the functions that entry points call, and that nothing else can."""
    return is_part(_part(function))


def entry_point(*sources: str | Path | None) -> Callable:
    """Decorator of a kernel's entry points: compiled at the first call, or from the cache.

    sources: the files that the kernel is made of; a change in any of them compiles it anew.
    """
    files = [file for file in (__file__, *sources) if file is not None]
    checksum = zlib.crc32(b"".join(Path(file).read_bytes() for file in files))

    def decorator(function: Callable) -> Callable:
        function.__qualname__ += f"_{checksum:08x}"
        kernel = numba.njit(**OPTIONS)(function)
        kernel._cache = KernelCache(f"{function.__module__}.{function.__qualname__}")
        kernel._compiler.compile = quick_typing()(as_kernel(kernel._compiler.compile))
        kernel.sources = frozenset(str(Path(file).resolve()) for file in files)
        return kernel

    return decorator


@intrinsic
def take(typingctx, counter):
    """counter[0] += 1, atomically; the value before. How threads share tasks."""

    def codegen(context, builder, signature, args):
        at = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", at, ir.IntType(64)(1), "monotonic")

    return types.int64(counter), codegen


@intrinsic
def _quick_empty(typingctx, shape, dtype):
    """np.empty of a shape, a number or a tuple."""
    return _array_type(shape, dtype)(shape, dtype), _make_array


@intrinsic
def _quick_zeros(typingctx, shape, dtype):
    """np.zeros, likewise."""

    def codegen(context, builder, signature, args):
        made = _make_array(context, builder, signature, args)
        array = context.make_array(signature.return_type)(context, builder, made)
        size = builder.mul(array.nitems, array.itemsize)
        cgutils.memset(builder, array.data, size, 0)
        return made

    return _array_type(shape, dtype)(shape, dtype), codegen


def _array_type(shape, dtype):
    dimensions = len(shape) if isinstance(shape, types.BaseTuple) else 1
    return types.Array(dtype.dtype, dimensions, "C")


def _make_array(context, builder, signature, args):
    lengths = arrayobj._parse_shape(context, builder, signature.args[0], args[0])
    return arrayobj._empty_nd_impl(context, builder, signature.return_type, lengths)._getvalue()


@register_jitable
def plain_empty(shape, dtype):
    """The same by numba's own np.empty."""
    return np.empty(shape, dtype)


@register_jitable
def plain_zeros(shape, dtype):
    """Likewise."""
    return np.zeros(shape, dtype)


_is_quick = hasattr(arrayobj, "_parse_shape") and hasattr(arrayobj, "_empty_nd_impl")
empty: Any = _quick_empty if _is_quick else plain_empty
zeros: Any = _quick_zeros if _is_quick else plain_zeros
"""What kernels use instead of np.empty and np.zeros, and they copy numbers in loops: numba compiles
a function, and the texts of its errors, for each type of these and of each assignment of an array
to a slice, a sixth of what all kernels take. Where numba lacks what this needs, they are its
own."""


@contextmanager
def announced(message: str) -> Iterator[None]:
    """Around the first call of an entry point: logs the message if compiling it takes long.

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
    log.info(message if can_be_kept() else message.replace("(once", "(in every run"))


def _before_fork() -> None:
    # What another thread compiles is finished first: a lock that it holds would never be released
    # in the forked process, which has no such thread.
    _compiling.acquire()
    global_compiler_lock.acquire()


def _after_fork() -> None:
    global_compiler_lock.release()
    _compiling.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_before_fork, after_in_parent=_after_fork, after_in_child=_after_fork
    )


def called(kernel: Any, message: str, *arguments: object) -> None:
    """Call an entry point; the message is logged if it must be compiled before."""
    if kernel.overloads:
        kernel(*arguments)
        return
    with announced(message):
        kernel(*arguments)


def must_be_compiled(kernel: Any) -> bool:
    """Whether an entry point's code is not on the disk, but can be kept there."""
    return not kernel.overloads and can_be_kept() and not kernel._cache.is_kept()
