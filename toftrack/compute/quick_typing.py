"""numba resolves `a * b` of two numbers anew wherever it is written; here it remembers.

For every operation of a kernel numba tries what all its extensions make of the types (sets,
strings, dates, ...) before it comes to numbers, a third of the time that a kernel takes to be
compiled. What it finds depends on the function and the types of the arguments alone.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import types
from numba.core.compiler_lock import global_compiler_lock
from numba.core.typing.context import BaseContext

from toftrack.compute.replacing import replaced

_PLAIN = (types.Number, types.Boolean, types.Array, types.BaseTuple, types.DType, types.Literal)
"""Types of which the same is said every time; a function among them might be compiled later."""
_signatures: dict[tuple, Any] = {}


@contextmanager
def quick_typing() -> Iterator[None]:
    """Within, what numba compiles is typed faster, and no garbage is looked for.

    numba keeps nearly all that it makes, which the collector would look through again and again.
    With a numba that has other insides, kernels are typed as ever.
    """
    if not (
        hasattr(BaseContext, "_lookup_global") and hasattr(BaseContext, "resolve_function_type")
    ):
        yield
        return
    with global_compiler_lock:
        collects = gc.isenabled()
        gc.disable()
        remembering = _remembering(BaseContext.resolve_function_type)
        try:
            with replaced(BaseContext, resolve_function_type=remembering):
                yield
        finally:
            if collects:
                gc.enable()


def _remembering(resolve: Callable) -> Callable:
    def resolve_function_type(self: BaseContext, func: Any, args: tuple, kws: Any) -> Any:
        # A function that an extension was added to since is another one.
        function = self._lookup_global(func) or func
        if isinstance(function, types.Dispatcher):
            return resolve(self, func, _without_literals(args), kws)
        if kws or not isinstance(function, types.Function) or not _are_plain(args):
            return resolve(self, func, args, kws)
        key = (id(self), function, *args)
        found = _signatures.get(key)
        if found is None:
            found = resolve(self, func, args, kws)
            if found is not None:
                _signatures[key] = found
        return found

    return resolve_function_type


def _without_literals(args: tuple) -> tuple:
    """A kernel's own function is compiled once for 0, 1 and all other whole numbers."""
    return tuple(
        types.unliteral(arg) if isinstance(arg, types.IntegerLiteral) else arg for arg in args
    )


def _are_plain(args: tuple) -> bool:
    return all(
        all(map(_is_plain, arg)) if isinstance(arg, types.BaseTuple) else _is_plain(arg)
        for arg in args
    )


def _is_plain(arg: types.Type) -> bool:
    return isinstance(arg, _PLAIN)
