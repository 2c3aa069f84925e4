"""What only kernels call is optimised within them alone, and computes the same."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.codegen import CPUCodeLibrary
from numba.core.cpu import CPUContext

from toftrack.compute import kernel_cache, whole_kernels
from toftrack.compute.compiling import compiled, entry_point

VALUES = np.linspace(-2, 3, 17)
OPTIMISE = CPUCodeLibrary._optimize_final_module


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    kernel_cache._usable.cache_clear()
    yield
    kernel_cache._usable.cache_clear()


def made() -> Callable[[np.ndarray, np.ndarray], None]:
    """A kernel that calls a function that calls another one."""

    @compiled
    def squared(x):
        return x * x

    @compiled
    def wave(x):
        return np.sin(x) + squared(x)

    @entry_point(__file__)
    def waves(values, out):
        for i in range(len(values)):
            out[i] = wave(values[i]) - squared(values[-1])

    return waves


def computed() -> np.ndarray:
    out = np.empty_like(VALUES)
    made()(VALUES, out)
    return out


def test_a_kernel_of_several_functions_computes_what_they_say() -> None:
    np.testing.assert_allclose(computed(), np.sin(VALUES) + VALUES**2 - 9, atol=1e-12)
    np.testing.assert_allclose(computed(), np.sin(VALUES) + VALUES**2 - 9, atol=1e-12)


def optimised(monkeypatch: pytest.MonkeyPatch) -> int:
    """How many functions numba optimises for such a kernel."""
    names: list[str] = []

    def noted(self: CPUCodeLibrary) -> None:
        names.append(self.name)
        OPTIMISE(self)

    monkeypatch.setattr(CPUCodeLibrary, "_optimize_final_module", noted)
    computed()
    return len(names)


def test_its_functions_are_not_optimised_by_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    assert optimised(monkeypatch) == 1


def test_with_another_numba_all_is_compiled_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(whole_kernels, "_INSIDES", ((CPUContext, "not there"),))
    assert optimised(monkeypatch) == 3
    np.testing.assert_allclose(computed(), np.sin(VALUES) + VALUES**2 - 9, atol=1e-12)


def test_what_cannot_be_compiled_leaves_numba_as_it_was() -> None:
    before = CPUCodeLibrary._optimize_final_module, CPUContext.get_executable

    @compiled
    def wrong(x):
        return x + "text"

    @entry_point(__file__)
    def kernel(values):
        values[0] = wrong(values[0])

    with pytest.raises(numba.TypingError):
        kernel(np.zeros(1))
    assert (CPUCodeLibrary._optimize_final_module, CPUContext.get_executable) == before
    assert not whole_kernels._parts
