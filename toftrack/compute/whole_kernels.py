"""Functions that only kernels call are optimised and translated within these, not by themselves.

numba optimises every function and makes machine code of it, and then once more within each kernel
that calls it, which is all that is ever run of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numba
from numba.core.codegen import CPUCodeLibrary
from numba.core.cpu import CPUContext

from toftrack.compute.replacing import replaced

_functions: Any = getattr(numba, "_dynfunc", None)
_INSIDES = (
    (CPUCodeLibrary, "_optimize_final_module"),
    (CPUCodeLibrary, "_finalize_final_module"),
    (CPUCodeLibrary, "_finalize_dynamic_globals"),
    (CPUCodeLibrary, "_ensure_finalized"),
    (CPUContext, "get_executable"),
    (_functions, "make_function"),
)
_parts: list[bool] = []
"""Of what is compiled now, the innermost last: whether it is such a function. numba compiles in one
thread at a time."""


def is_part(kernel: Any) -> Any:
    """A numba function that nothing but kernels calls."""
    kernel._compiler.compile = _compiling(True, kernel._compiler.compile)
    return kernel


def as_kernel(compile_it: Callable) -> Callable:
    """numba's compilation of a kernel, as a whole."""
    return whole_kernels()(_compiling(False, compile_it))


@contextmanager
def whole_kernels() -> Iterator[None]:
    """Within, kernels are compiled as wholes, numba's lock being held.

    With a numba that has other insides, they are compiled as ever.
    """
    if not all(hasattr(owner, name) for owner, name in _INSIDES):
        yield
        return
    optimise = CPUCodeLibrary._optimize_final_module
    finish = CPUCodeLibrary._finalize_final_module
    get_executable = CPUContext.get_executable

    def optimise_kernel(self: Any) -> None:
        if not _in_part():
            optimise(self)

    def finish_kernel(self: Any) -> None:
        if not _in_part():
            finish(self)
            return
        self._finalize_dynamic_globals()
        self._finalized = True

    def executable(self: Any, library: Any, fndesc: Any, env: Any) -> Any:
        if not _in_part():
            return get_executable(self, library, fndesc, env)
        library._ensure_finalized()
        # What numba knows it by; there is nothing that could be called.
        name = fndesc.qualname.split(".")[-1]
        make = _functions.make_function
        return make(fndesc.lookup_module(), name, "", 0, env, (library,))

    with (
        replaced(
            CPUCodeLibrary,
            _optimize_final_module=optimise_kernel,
            _finalize_final_module=finish_kernel,
        ),
        replaced(CPUContext, get_executable=executable),
    ):
        yield


def _in_part() -> bool:
    """Whether what is compiled now is such a function."""
    return bool(_parts) and _parts[-1]


def _compiling(part: bool, compile_it: Callable) -> Callable:
    def run(*args: Any, **kwargs: Any) -> Any:
        _parts.append(part)
        try:
            return compile_it(*args, **kwargs)
        finally:
            _parts.pop()

    return run
