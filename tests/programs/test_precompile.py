"""Kernels that were never compiled are compiled by a second process as well, and only those."""

from __future__ import annotations

import subprocess

import pytest
from helpers.tracking import configuration

from toftrack.compute import compiling
from toftrack.programs import precompile


def test_the_second_process_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    class Process:
        def __init__(self, command: list[str], **options: object) -> None:
            assert command[1:] == ["-m", "toftrack.programs.precompile"]

        def wait(self) -> int:
            done.append("waited")
            return 0

        def kill(self) -> None:
            done.append("ended")

    monkeypatch.setattr(subprocess, "Popen", Process)
    monkeypatch.setattr(precompile.os, "sched_getaffinity", lambda process: {0, 1}, raising=False)
    monkeypatch.setattr(compiling, "must_be_compiled", lambda kernel: True)
    assert precompile.ready_tracker(configuration()).model.backend.name == "numba"
    assert done == ["waited", "ended", "waited"]


def test_without_compiled_kernels_there_is_no_second_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(compiling, "must_be_compiled", lambda kernel: pytest.fail("asked"))
    assert precompile.ready_tracker(configuration("renderer=torch")).model.backend.name == "torch"
