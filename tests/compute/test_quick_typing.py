"""Kernels are typed once for what is the same, and a run compiles and imports what it needs."""

from __future__ import annotations

import gc
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from helpers.tracking import ROOT
from numba.core.typing.context import BaseContext

from toftrack.compute import kernel_cache
from toftrack.compute.compiling import compiled, entry_point

_RUN = """
import sys
from numba.core.dispatcher import Dispatcher
from toftrack.programs.main import main

main(["track", "device.stop=2", "view=none", "hydra.run.dir=" + sys.argv[1]])
for name, module in list(sys.modules.items()):
    for value in vars(module).values() if name.startswith("toftrack") else ():
        if isinstance(value, Dispatcher) and len(value.signatures) > 1:
            print("TWICE", value, value.signatures)
print("UNUSED", {"sklearn", "matplotlib", "av", "rerun", "onnx"} & set(sys.modules) or "none")
"""


@pytest.fixture
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    kernel_cache._usable.cache_clear()


@pytest.mark.usefixtures("_own_cache")
def test_a_function_is_compiled_once_for_all_whole_numbers() -> None:
    @compiled
    def twice(value):
        return 2 * value

    @entry_point(__file__)
    def total(values):
        values[0] = twice(0) + twice(1) + twice(len(values))

    values = np.zeros(3, np.int64)
    total(values)
    assert values[0] == 8 and len(twice.signatures) == 1


@pytest.mark.usefixtures("_own_cache")
def test_what_cannot_be_compiled_leaves_numba_and_the_collector_as_they_were() -> None:
    before = BaseContext.resolve_function_type

    @entry_point(__file__)
    def wrong(values):
        values[0] = values + "text"

    with pytest.raises(numba.TypingError):
        wrong(np.zeros(1))
    assert BaseContext.resolve_function_type is before and gc.isenabled()


def test_a_run_loads_each_kernel_for_one_signature_and_no_package_in_vain(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _RUN, str(tmp_path)]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert "TWICE" not in ran.stdout and "UNUSED none" in ran.stdout
