"""Kernels that were never compiled are compiled by a second process as well, and only those."""

from __future__ import annotations

import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers.tracking import configuration

from toftrack.programs import ahead


def kernel(folder: Path | None, signatures: tuple = ()) -> SimpleNamespace:
    function = SimpleNamespace(__qualname__="refine_hands_0123abcd")
    stats = SimpleNamespace(cache_path=folder and str(folder))
    return SimpleNamespace(py_func=function, stats=stats, signatures=signatures)


def test_what_is_on_the_disk_is_not_compiled(tmp_path: Path) -> None:
    assert ahead.must_be_compiled(kernel(tmp_path))
    (tmp_path / "gauss_newton_numba.refine_hands_ffffffff-98.py311.nbi").touch()
    assert ahead.must_be_compiled(kernel(tmp_path)), "of an older version"
    (tmp_path / "gauss_newton_numba.refine_hands_0123abcd-98.py311.nbi").touch()
    assert not ahead.must_be_compiled(kernel(tmp_path))


def test_nothing_is_compiled_ahead_that_cannot_be_kept_or_is_there(tmp_path: Path) -> None:
    assert not ahead.must_be_compiled(kernel(None))
    assert not ahead.must_be_compiled(kernel(tmp_path, signatures=("made",)))


def test_the_second_process_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    class Process:
        def __init__(self, command: list[str], **options: object) -> None:
            assert command[1:] == ["-m", "toftrack.programs.ahead"]

        def wait(self) -> int:
            done.append("waited")
            return 0

        def kill(self) -> None:
            done.append("ended")

    monkeypatch.setattr(subprocess, "Popen", Process)
    monkeypatch.setattr(ahead.os, "sched_getaffinity", lambda process: {0, 1}, raising=False)
    monkeypatch.setattr(ahead, "must_be_compiled", lambda kernel: True)
    assert ahead.ready_tracker(configuration()).model.backend.name == "numba"
    assert done == ["waited", "ended", "waited"]


def test_without_compiled_kernels_there_is_no_second_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ahead, "must_be_compiled", lambda kernel: pytest.fail("asked"))
    assert ahead.ready_tracker(configuration("renderer=torch")).model.backend.name == "torch"
