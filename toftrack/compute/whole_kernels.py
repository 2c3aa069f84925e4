"""Functions that only kernels call are optimised and translated within these, not by themselves.

numba optimises every function and makes machine code of it, and then once more within each kernel
that calls it, which is all that is ever run of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba import _dynfunc  # type: ignore[attr-defined]
from numba.core.codegen import CPUCodeLibrary
from numba.core.cpu import CPUContext

_INSIDES = (
    (CPUCodeLibrary, "_optimize_final_module"),
    (CPUCodeLibrary, "_finalize_final_module"),
    (CPUCodeLibrary, "_finalize_dynamic_globals"),
    (CPUCodeLibrary, "_ensure_finalized"),
    (CPUContext, "get_executable"),
    (_dynfunc, "make_function"),
)
_parts: list[bool] = []
"""Of what is compiled now, the innermost last: whether it is such a function. numba compiles in one
thread at a time."""


def is_part(kernel: Any) -> Any:
    """A numba function that nothing but kernels calls."""
    kernel._compiler.compile = _compiling(True, kernel._compiler.compile)
    return kernel


@contextmanager
def whole_kernels() -> Iterator[None]:
    """Within, kernels are compiled as wholes, numba's lock being held.

    With a numba that has other insides, they are compiled as ever.
    """
    if not all(hasattr(owner, name) for owner, name in _INSIDES):
        yield
        return
    optimise, finish = CPUCodeLibrary._optimize_final_module, CPUCodeLibrary._finalize_final_module
    get_executable = CPUContext.get_executable

    def _optimize_final_module(self: Any) -> None:
        if not _parts[-1:] == [True]:
            optimise(self)

    def _finalize_final_module(self: Any) -> None:
        if not _parts[-1:] == [True]:
            finish(self)
            return
        self._finalize_dynamic_globals()
        self._finalized = True

    def _get_executable(self: Any, library: Any, fndesc: Any, env: Any) -> Any:
        if not _parts[-1:] == [True]:
            return get_executable(self, library, fndesc, env)
        library._ensure_finalized()
        # What numba knows it by; there is nothing that could be called.
        name = fndesc.qualname.split(".")[-1]
        return _dynfunc.make_function(fndesc.lookup_module(), name, "", 0, env, (library,))

    CPUCodeLibrary._optimize_final_module = _optimize_final_module  # type: ignore[method-assign]
    CPUCodeLibrary._finalize_final_module = _finalize_final_module  # type: ignore[method-assign]
    CPUContext.get_executable = _get_executable  # type: ignore[method-assign]
    try:
        yield
    finally:
        CPUCodeLibrary._optimize_final_module = optimise  # type: ignore[method-assign]
        CPUCodeLibrary._finalize_final_module = finish  # type: ignore[method-assign]
        CPUContext.get_executable = get_executable  # type: ignore[method-assign]


def as_kernel(compile_it: Callable) -> Callable:
    """numba's compilation of a kernel, as a whole."""

    def run(*args: Any, **kwargs: Any) -> Any:
        with whole_kernels():
            return _compiling(False, compile_it)(*args, **kwargs)

    return run


def _compiling(part: bool, compile_it: Callable) -> Callable:
    def run(*args: Any, **kwargs: Any) -> Any:
        _parts.append(part)
        try:
            return compile_it(*args, **kwargs)
        finally:
            _parts.pop()

    return run
