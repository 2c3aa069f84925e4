"""Kernels that were never compiled are compiled by a second process as well, and only those."""

from __future__ import annotations

import pytest
from helpers.tracking import configuration

from toftrack.compute import compiling
from toftrack.programs import precompile


def test_the_second_process_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    class Process:
        def start(self) -> None:
            done.append("begun")

        def join(self) -> None:
            done.append("waited")

        def kill(self) -> None:
            done.append("ended")

    class Context:
        def Process(self, target: object, daemon: bool) -> Process:  # noqa: N802
            assert target is precompile._compile_beside and daemon
            return Process()

    monkeypatch.setattr(precompile.multiprocessing, "get_context", lambda method: Context())
    monkeypatch.setattr(precompile.os, "sched_getaffinity", lambda process: {0, 1}, raising=False)
    monkeypatch.setattr(compiling, "must_be_compiled", lambda kernel: True)
    assert precompile.ready_tracker(configuration()).model.backend.name == "numba"
    assert done == ["begun", "waited", "ended", "waited"]


def test_without_compiled_kernels_there_is_no_second_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(compiling, "must_be_compiled", lambda kernel: pytest.fail("asked"))
    assert precompile.ready_tracker(configuration("renderer=torch")).model.backend.name == "torch"
