"""Compiling a kernel is announced if it takes long, and where its code cannot be kept."""

from __future__ import annotations

import importlib
import inspect
import logging
import pkgutil
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic

import toftrack
from toftrack.compute import compiling
from toftrack.compute.compiling import announced


@pytest.mark.parametrize(("silent_s", "reported"), [(0.0, ["compiling"]), (1000.0, [])])
def test_only_what_takes_long_is_announced(
    silent_s: float,
    reported: list[str],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(compiling, "_SILENT_S", silent_s)
    caplog.set_level(logging.INFO)
    with announced("compiling"):
        deadline = time.monotonic() + 20
        while len(caplog.messages) < len(reported) and time.monotonic() < deadline:
            time.sleep(0.01)
    assert caplog.messages == reported


def test_where_the_code_cannot_be_kept_it_is_said_to_be_compiled_in_every_run(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(compiling, "can_be_kept", lambda: False)
    monkeypatch.setattr(compiling, "_SILENT_S", 0.0)
    caplog.set_level(logging.INFO)
    with announced("compiling (once, about 6 s)"):
        deadline = time.monotonic() + 20
        while not caplog.messages and time.monotonic() < deadline:
            time.sleep(0.01)
    assert caplog.messages == ["compiling (in every run, about 6 s)"]


def _made_of(function: Callable, seen: set[Callable]) -> set[Callable]:
    """All that a kernel calls, itself included, through any number of others."""
    if function not in seen:
        seen.add(function)
        captured = inspect.getclosurevars(function)
        for value in (*captured.globals.values(), *captured.nonlocals.values()):
            if isinstance(value, Dispatcher):
                _made_of(value.py_func, seen)
            elif isinstance(value, _Intrinsic):
                seen.add(value._defn)
    return seen


def test_a_change_in_any_file_that_a_kernel_is_made_of_compiles_it_anew() -> None:
    kernels: dict[Callable, frozenset[str]] = {}
    for found in pkgutil.walk_packages(toftrack.__path__, "toftrack."):
        if "numba" in found.name or found.name == "toftrack.detector.pictures":
            for value in vars(importlib.import_module(found.name)).values():
                if isinstance(value, Dispatcher) and hasattr(value, "sources"):
                    kernels[value.py_func] = value.sources
    assert len(kernels) > 10
    for kernel, sources in kernels.items():
        files = {str(Path(inspect.getfile(part)).resolve()) for part in _made_of(kernel, set())}
        assert files <= sources, f"{kernel.__qualname__} is also made of {files - sources}"


@pytest.mark.parametrize("shape", [5, (3, 4), (2, 0, 3)])
@pytest.mark.parametrize("dtype", [np.float32, np.int64, np.uint8])
def test_a_kernel_s_arrays_are_numpy_s_also_where_numba_lacks_what_makes_them_quickly(
    shape: int | tuple[int, ...], dtype: type
) -> None:
    def made(empty: Callable, zeros: Callable) -> tuple[np.ndarray, np.ndarray]:
        return numba.njit(lambda size: (empty(size, dtype), zeros(size, dtype)))(shape)

    expected = np.zeros(shape, dtype)
    for empty, zeros in (
        made(compiling.empty, compiling.zeros),
        made(compiling.plain_empty, compiling.plain_zeros),
    ):
        assert empty.shape == expected.shape and empty.dtype == expected.dtype
        assert empty.flags.c_contiguous and zeros.flags.c_contiguous
        np.testing.assert_array_equal(zeros, expected)
