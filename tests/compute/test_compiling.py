"""Compiling a kernel is announced if it takes long, and where its code cannot be kept."""

from __future__ import annotations

import logging
import time

import pytest

from toftrack.compute import compiling
from toftrack.compute.compiling import announced


@pytest.mark.parametrize(("silent_s", "told"), [(0.0, ["compiling"]), (1000.0, [])])
def test_only_what_takes_long_is_announced(
    silent_s: float,
    told: list[str],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(compiling, "_SILENT_S", silent_s)
    caplog.set_level(logging.INFO)
    with announced("compiling"):
        deadline = time.monotonic() + 20
        while len(caplog.messages) < len(told) and time.monotonic() < deadline:
            time.sleep(0.01)
    assert caplog.messages == told


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
