"""Compiling a kernel is announced if it takes long."""

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
